"""Files are checked against other libraries' readers and writers, and against closed forms."""

import json
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
import trimesh
from PIL import Image

from torchdls import io
from torchdls._files import atomic_file, check_output
from torchdls.geometry import normals_to_gradient

RNG = np.random.default_rng(0)


def unit_normals(h=6, w=8):
    n = RNG.normal(size=(3, h, w))
    n[2] = abs(n[2]) + 0.3
    return n / np.linalg.norm(n, axis=0)


def bowl(h=5, w=7):
    y, x = np.mgrid[:h, :w]
    return torch.from_numpy(((x - 3.0) ** 2 + 2 * (y - 2.0) ** 2) / 10)


def save_png16_rgb(path, codes):
    """A 16-bit RGB PNG, which Pillow and imageio cannot write."""
    import kornia

    kornia.io.write_image(path, torch.from_numpy(np.ascontiguousarray(np.moveaxis(codes, -1, 0))))


# --- normal maps ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["png8", "png16", "tiff8", "tiff16"])
def test_integer_normal_maps_keep_every_bit(tmp_path, form):
    n = unit_normals()
    bits = np.uint16 if form.endswith("16") else np.uint8
    top = np.iinfo(bits).max
    codes = np.rint((np.moveaxis(n, 0, -1) + 1) / 2 * top).astype(bits)
    path = tmp_path / f"map.{form.rstrip('0123456789')}"
    if form == "png8":
        Image.fromarray(codes).save(path)
    elif form == "png16":
        save_png16_rgb(path, codes)
    else:
        tifffile.imwrite(path, codes, photometric="rgb")
    field = io.load_field(path)
    decoded = 2 * np.moveaxis(codes.astype(np.float64), -1, 0) / top - 1
    decoded /= np.linalg.norm(decoded, axis=0)
    assert field.kind == "normals"
    assert field.mask is None
    assert field.values.dtype == torch.float32
    np.testing.assert_allclose(field.values[0].numpy(), decoded, atol=1e-7)
    np.testing.assert_allclose(field.values[0].numpy(), n, atol=2.5 / top)


def test_alpha_is_the_mask(tmp_path):
    codes = np.full((4, 5, 4), 255, np.uint8)
    codes[..., :3] = np.rint((np.moveaxis(unit_normals(4, 5), 0, -1) + 1) / 2 * 255)
    codes[1, 2, 3] = 0
    Image.fromarray(codes).save(tmp_path / "n.png")
    mask = io.load_field(tmp_path / "n.png").mask
    assert mask.shape == (1, 1, 4, 5)
    assert (~mask).nonzero().tolist() == [[0, 0, 1, 2]]


def test_palette_maps_are_expanded(tmp_path):
    codes = np.zeros((4, 4, 3), np.uint8)
    codes[:, :2], codes[:, 2:] = (128, 128, 255), (200, 128, 230)
    Image.fromarray(codes).convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "p.png")
    Image.fromarray(codes).save(tmp_path / "rgb.png")
    torch.testing.assert_close(io.load_field(tmp_path / "p.png").values, io.load_field(tmp_path / "rgb.png").values)


def test_black_gray_and_white_backgrounds_are_invalid_in_every_convention(tmp_path):
    codes = np.full((4, 4, 3), (128, 128, 255), np.uint8)
    codes[0, 0], codes[0, 1], codes[0, 2], codes[0, 3] = 0, 127, 128, 255
    Image.fromarray(codes).save(tmp_path / "n.png")
    values = io.load_field(tmp_path / "n.png").values
    assert (values[0, :, 0] == 0).all()
    for convention in ("opengl", "directx", "kornia"):
        assert normals_to_gradient(values, convention).invalid.tolist() == [4]
    assert normals_to_gradient(-values, "opencv").invalid.tolist() == [4]


@pytest.mark.parametrize("encoded", [False, True])
def test_float_tiff_in_either_range(tmp_path, encoded):
    n = unit_normals().astype(np.float32)
    stored = (n + 1) / 2 if encoded else n
    tifffile.imwrite(tmp_path / "n.tiff", np.moveaxis(stored, 0, -1), photometric="rgb")
    np.testing.assert_allclose(io.load_field(tmp_path / "n.tiff").values[0].numpy(), n, atol=1e-6)


# --- arrays --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f8"])
@pytest.mark.parametrize("channels, kind", [(2, "gradient"), (3, "normals")])
def test_npy_by_number_of_channels(tmp_path, channels, kind, dtype):
    array = (unit_normals(5, 7) if channels == 3 else RNG.normal(size=(2, 5, 7))).astype(dtype)
    for name, stored in (("first", array), ("last", np.moveaxis(array, 0, -1)), ("batch", array[None])):
        np.save(tmp_path / f"{name}.npy", stored)
        field = io.load_field(tmp_path / f"{name}.npy")
        assert field.kind == kind
        assert field.values.shape == (1, channels, 5, 7)
        assert field.values.dtype == (torch.float64 if np.dtype(dtype).itemsize == 8 else torch.float32)
        np.testing.assert_array_equal(field.values[0].numpy(), array)


def test_npz_with_everything(tmp_path):
    gradient, mask, weight = RNG.normal(size=(2, 5, 7)), RNG.random((5, 7)) > 0.3, RNG.random((2, 5, 7))
    np.savez(tmp_path / "g.npz", gradient=gradient, mask=mask, weight=weight, pixel_size=[0.5, 2.0])
    field = io.load_field(tmp_path / "g.npz")
    assert field.kind == "gradient"
    assert field.pixel_size == (0.5, 2.0)
    np.testing.assert_array_equal(field.values[0], gradient)
    np.testing.assert_array_equal(field.mask[0, 0], mask)
    np.testing.assert_array_equal(field.weight[0], weight)
    np.testing.assert_array_equal(io.load_mask(tmp_path / "g.npz")[0, 0], mask)


def test_two_channel_tiff_is_a_gradient(tmp_path):
    gradient = RNG.normal(size=(2, 5, 7)).astype(np.float32)
    tifffile.imwrite(tmp_path / "g.tiff", gradient, photometric="minisblack")
    field = io.load_field(tmp_path / "g.tiff")
    assert field.kind == "gradient"
    np.testing.assert_array_equal(field.values[0], gradient)


@pytest.mark.parametrize("form", ["1", "L", "LA", "RGB", "P", "I;16", "tiff", "npy", "jpg"])
def test_masks_in_every_form(tmp_path, form):
    mask = np.zeros((16, 24), bool)
    mask[:8, 8:] = True
    image = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8))
    path = tmp_path / ("m." + (form if form in ("tiff", "npy", "jpg") else "png"))
    if form == "npy":
        np.save(path, mask)
    elif form == "tiff":
        tifffile.imwrite(path, np.where(mask, 65535, 0).astype(np.uint16))
    elif form == "I;16":
        Image.fromarray(np.where(mask, 65535, 0).astype(np.uint16)).save(path)
    else:
        (image if form == "jpg" else image.convert(form)).save(path)
    loaded = io.load_mask(path)
    assert loaded.dtype == torch.bool
    assert loaded.shape == (1, 1, 16, 24)
    np.testing.assert_array_equal(loaded[0, 0], mask)


@pytest.mark.parametrize("suffix", ["npy", "npz", "txt"])
def test_camera(tmp_path, suffix):
    k = np.array([[500, 0, 32.5], [0, 510, 24], [0, 0, 1]])
    path = tmp_path / f"k.{suffix}"
    writers: dict[str, Any] = {"npy": np.save, "txt": np.savetxt, "npz": lambda p, k: np.savez(p, K=k)}
    writers[suffix](path, k)
    np.testing.assert_array_equal(io.load_camera(path), k)


# --- heights -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix, atol", [("npz", 0), ("npy", 0), ("tiff", 1e-6), ("png", 3.7 / 65534)])
def test_heights_come_back_with_nan_outside(tmp_path, suffix, atol):
    height, path = bowl(), tmp_path / f"z.{suffix}"
    mask = torch.ones(5, 7, dtype=torch.bool)
    mask[2, 3:5] = False
    before = height.clone()
    io.save_height(path, height[None, None], mask=mask, pixel_size=(0.5, 2.0))
    back = io.load_height(path)
    assert back.mask[0, 0].equal(mask)
    assert back.height[0, 0][~mask].isnan().all()
    torch.testing.assert_close(back.height[0, 0][mask].double(), height[mask], rtol=0, atol=atol)
    assert back.pixel_size == ((1.0, 1.0) if suffix == "npy" else (0.5, 2.0))
    assert height.equal(before)


def test_png_says_what_its_codes_mean(tmp_path):
    height = bowl()
    io.save_height(tmp_path / "z.png", height)
    with Image.open(tmp_path / "z.png") as image:
        codes, notes = np.asarray(image).astype(np.float64), json.loads(image.info["torchdls"])
    assert codes.min() == 1
    assert codes.max() == 65535
    np.testing.assert_allclose(notes["offset"] + notes["scale"] * codes, height, atol=notes["scale"])
    io.save_height(tmp_path / "flat.png", torch.full((3, 3), 2.5))
    assert (io.load_height(tmp_path / "flat.png").height == 2.5).all()


def test_tiff_is_plain_float32(tmp_path):
    io.save_height(tmp_path / "z.tif", bowl(), quantity="depth")
    np.testing.assert_allclose(tifffile.imread(tmp_path / "z.tif"), bowl(), rtol=1e-6)
    with Image.open(tmp_path / "z.tif") as image:  # other readers agree
        np.testing.assert_allclose(np.asarray(image), bowl(), rtol=1e-6)


def test_npz_takes_more_arrays_and_is_input_again(tmp_path):
    gradient = torch.randn(1, 2, 5, 7, generator=torch.Generator().manual_seed(0))
    io.save_height(tmp_path / "z.npz", bowl(), gradient=gradient[0], note=3.0)
    with np.load(tmp_path / "z.npz") as file:
        assert set(file.files) == {"height", "mask", "pixel_size", "gradient", "note"}
    assert io.load_field(tmp_path / "z.npz").values.equal(gradient)


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb"])
def test_meshes(tmp_path, suffix):
    mask = torch.ones(5, 7, dtype=torch.bool)
    mask[0, 0] = mask[4, 5] = False
    path = tmp_path / f"z.{suffix}"
    io.save_height(path, bowl(), mask=mask, pixel_size=(0.5, 2.0))
    mesh = trimesh.load_mesh(path)
    assert len(mesh.vertices) == 33
    # 24 cells of 2 triangles; the corner's cell loses one, the two cells at the gap lose one each.
    assert len(mesh.faces) == 48 - 3
    found = {tuple(v) for v in np.round(mesh.vertices, 4).tolist()}
    z = bowl()
    rows, columns = mask.nonzero().T.tolist()
    assert found == {(0.5 * c, -2.0 * r + 0.0, round(float(z[r, c]), 4)) for r, c in zip(rows, columns, strict=True)}
    assert (mesh.face_normals[:, 2] > 0).all()  # seen from the viewer, counter-clockwise


def test_mesh_of_given_points_covers_the_mask(tmp_path):
    mask = torch.rand(20, 30, generator=torch.Generator().manual_seed(1)) > 0.3
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    points = torch.stack([x, -y, torch.zeros_like(x)])
    points[:, ~mask] = float("nan")
    io.save_mesh(tmp_path / "p.ply", points[None])
    cells = sum(mask[i : i + 19, j : j + 29].long() for i in (0, 1) for j in (0, 1))
    area = (cells == 4).sum() + 0.5 * (cells == 3).sum()
    assert trimesh.load_mesh(tmp_path / "p.ply").area == pytest.approx(float(area), rel=1e-5)


# --- whole or not at all -------------------------------------------------------------------------------------------


def test_nothing_is_replaced_without_overwrite(tmp_path):
    path = tmp_path / "z.npy"
    io.save_height(path, bowl())
    with pytest.raises(FileExistsError, match="exists already"):
        io.save_height(path, bowl() * 2)
    assert io.load_height(path).height[0, 0].equal(bowl())
    io.save_height(path, bowl() * 2, overwrite=True)
    assert io.load_height(path).height[0, 0].equal(bowl() * 2)
    assert [p.name for p in tmp_path.iterdir()] == ["z.npy"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_file_and_no_trace(tmp_path, error):
    path = tmp_path / "z.bin"
    path.write_bytes(b"old")

    def fail():
        with atomic_file(path, overwrite=True) as file:
            file.write(b"half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["z.bin"]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    path = tmp_path / "z.bin"

    def race():
        with atomic_file(path) as file:
            file.write(b"new")
            path.write_bytes(b"theirs")

    with pytest.raises(FileExistsError):
        race()
    assert path.read_bytes() == b"theirs"
    assert len(list(tmp_path.iterdir())) == 1


# --- bad input -----------------------------------------------------------------------------------------------------


def bad_files(folder):
    """Name -> content of files that no reader may accept."""
    np.save(folder / "ok.npy", np.zeros((2, 5, 7)))
    good = (folder / "ok.npy").read_bytes()
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(folder / "ok.png")
    png = (folder / "ok.png").read_bytes()
    np.save(folder / "pickle.npy", np.array([{}], dtype=object))
    np.save(folder / "shape.npy", np.zeros((4, 5, 7)))
    np.save(folder / "int.npy", np.zeros((2, 5, 7), int))
    np.savez(folder / "keys.npz", z=np.zeros((5, 7)))
    np.savez(folder / "sizes.npz", gradient=np.zeros((2, 5, 7)), mask=np.ones((5, 6)))
    np.savez(folder / "spacing.npz", gradient=np.zeros((2, 5, 7)), pixel_size=[0.0, 1.0])
    np.savez(folder / "three.npz", gradient=np.zeros((3, 5, 7)))
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(folder / "gray.png")
    for name, content in {
        "empty.npy": b"",
        "cut.npy": good[:-9],
        "head.npy": good[:9],
        "text.npz": b"hello",
        "cut.npz": b"PK\x03\x04rest",
        "text.png": b"hello",
        "cut.png": png[:60],
        "short.png": png[:20],
        "text.tiff": b"hello",
        "cut.tiff": b"II*\0\x08",
        "cut.exr": b"v/1\x01",
        "field.xyz": b"",
    }.items():
        (folder / name).write_bytes(content)


BAD = {
    ".npy": ["pickle", "shape", "int", "empty", "cut", "head"],
    ".npz": ["keys", "sizes", "spacing", "three", "text", "cut"],
    ".png": ["gray", "text", "cut", "short"],
    ".tiff": ["text", "cut"],
    ".exr": ["cut"],
    ".xyz": ["field"],
}


@pytest.mark.parametrize("name", [name + suffix for suffix, names in BAD.items() for name in names])
def test_a_bad_file_is_one_error_that_names_it(tmp_path, name):
    bad_files(tmp_path)
    with pytest.raises(ValueError, match=name) as caught:
        io.load_field(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_missing_file_or_directory_or_format(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png"):
        io.load_field(tmp_path / "none.png")
    with pytest.raises(FileNotFoundError, match="directory"):
        io.save_height(tmp_path / "none" / "z.npy", bowl())
    with pytest.raises(ValueError, match=r"unknown format '.xyz', choose from .npz"):
        io.save_height(tmp_path / "z.xyz", bowl())
    with pytest.raises(FileExistsError):
        check_output(tmp_path, overwrite=True)
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "foreign.png")
    with pytest.raises(ValueError, match="no text chunk"):
        io.load_height(tmp_path / "foreign.png")


@pytest.mark.parametrize(
    "match, call",
    [
        ("height: shape", lambda p: io.save_height(p / "z.npy", torch.zeros(2, 1, 3, 4))),
        ("mask: shape", lambda p: io.save_height(p / "z.npy", torch.zeros(3, 4), mask=torch.ones(4, 3) > 0)),
        ("no valid pixel", lambda p: io.save_height(p / "z.npy", torch.full((3, 4), torch.nan))),
        ("no triangle", lambda p: io.save_height(p / "z.ply", torch.zeros(3, 4), mask=torch.eye(3, 4) > 0)),
        ("points: shape", lambda p: io.save_mesh(p / "z.ply", torch.zeros(2, 3, 4))),
    ],
)
def test_bad_arguments_write_nothing(tmp_path, match, call):
    with pytest.raises(ValueError, match=match):
        call(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_missing_library_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"pip install 'torchdls\[files\]'"):
        io.save_height(tmp_path / "z.ply", bowl())
    assert not list(tmp_path.iterdir())
