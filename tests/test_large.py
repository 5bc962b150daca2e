"""Least squares out of core: equal to the whole, whatever the tiles, the file and the memory."""

import numpy as np
import pytest
import torch

from torchdls import LeastSquares, convert_gradient, gradient_to_normals, io, large
from torchdls.surfaces import SURFACES


def field(h, w, dtype=np.float64):
    rng = np.random.default_rng(h * w)
    g = SURFACES["peaks"](max(h, w), dtype=torch.float64).gradient[0, :, :h, :w].numpy()
    return (g + 0.3 * rng.normal(size=g.shape)).astype(dtype)


def whole(g, **options):
    return LeastSquares(**options)(torch.from_numpy(np.ascontiguousarray(g)))[0].numpy()


@pytest.mark.parametrize("size", [(100, 130), (65, 40), (1, 90), (90, 1), (33, 200)])
@pytest.mark.parametrize("tile", [1, 7, 64, 1000])
def test_equal_to_the_whole_for_any_tile(size, tile):
    g, found = field(*size), np.empty(size)
    result = large.integrate(g, found, tile=tile, pixel_size=(2.0, 0.5))
    np.testing.assert_allclose(found, whole(g, pixel_size=(2.0, 0.5)), rtol=0, atol=1e-10)
    assert result.shape == size
    assert result.passes == (-(-size[0] // tile), -(-size[1] // tile), -(-size[0] // tile))


def test_in_single_precision():
    g, found = field(150, 170, np.float32), np.empty((150, 170), np.float32)
    large.integrate(g, found, tile=32)
    exact = whole(g.astype(np.float64))
    assert np.abs(found - exact).max() < 3e-6 * np.ptp(exact)


@pytest.mark.parametrize("suffix", [".npy", ".tiff"])
def test_files_in_and_out(tmp_path, suffix):
    g = field(300, 280, np.float32)
    np.save(tmp_path / "g.npy", g)
    out = tmp_path / f"z{suffix}"
    large.integrate(tmp_path / "g.npy", out, tile=100)
    found = io.load_height(out).height[0, 0].numpy()
    np.testing.assert_allclose(found, whole(g), rtol=0, atol=1e-3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["g.npy", out.name]
    with pytest.raises(FileExistsError):
        large.integrate(tmp_path / "g.npy", out)
    large.integrate(tmp_path / "g.npy", out, overwrite=True, memory=2**20)
    np.testing.assert_allclose(io.load_height(out).height[0, 0].numpy(), found, rtol=0, atol=1e-3)
    if suffix == ".tiff":
        import tifffile

        with tifffile.TiffFile(out) as file:
            assert file.is_bigtiff
            assert file.pages[0].is_tiled


def test_zarr_in_and_out(tmp_path):
    zarr = pytest.importorskip("zarr")
    g = field(130, 90, np.float32)
    array = zarr.create_array(tmp_path / "g.zarr", shape=g.shape, dtype=g.dtype, chunks=(2, 64, 64))
    array[:] = g
    large.integrate(tmp_path / "g.zarr", tmp_path / "z.zarr", tile=50)
    np.testing.assert_allclose(zarr.open_array(tmp_path / "z.zarr", mode="r")[:], whole(g), rtol=0, atol=1e-4)


def test_a_tiff_in(tmp_path):
    import tifffile

    g = field(70, 90, np.float32)
    tifffile.imwrite(tmp_path / "g.tif", g, photometric="minisblack")
    found = np.empty((70, 90), np.float32)
    large.integrate(tmp_path / "g.tif", found, tile=30)
    np.testing.assert_allclose(found, whole(g), rtol=0, atol=1e-4)


@pytest.mark.parametrize("convention", ["opengl", "directx", "matlab"])
def test_normals(convention):
    g = torch.from_numpy(field(80, 70))
    normals = gradient_to_normals(g, convention).numpy()
    found = np.empty((80, 70))
    large.integrate(normals, found, tile=30, convention=convention)
    np.testing.assert_allclose(found, whole(g.numpy()), rtol=0, atol=1e-9)


def test_gradient_conventions():
    g = field(40, 50)
    found = np.empty((40, 50))
    large.integrate(g, found, tile=16, convention="depth")
    np.testing.assert_allclose(found, whole(convert_gradient(torch.from_numpy(g), "depth").numpy()), rtol=0, atol=1e-10)


def test_memory_says_how_much_at_once():
    class Watched:
        """An array that notes the largest part that was asked for."""

        def __init__(self, array):
            self.array, self.most, self.shape, self.dtype = array, 0, array.shape, array.dtype

        def __getitem__(self, part):
            found = self.array[part]
            self.most = max(self.most, found.nbytes)
            return found

    g, found = Watched(field(2000, 100, np.float32)), np.empty((2000, 100), np.float32)
    result = large.integrate(g, found, memory=2**21)
    assert result.tile == 2**21 // (16 * 4 * 2000)
    assert g.most <= 2 * 4 * 100 * (result.tile + 2)


@pytest.mark.parametrize(
    "change, error, match",
    [
        ({"source": np.zeros((1, 8, 8))}, ValueError, r"source \(1, 8, 8\)"),
        ({"source": np.zeros((2, 8, 8), int)}, TypeError, "floats are needed"),
        ({"source": np.full((2, 8, 8), np.nan)}, ValueError, "not finite in rows 0 to 7"),
        ({"source": np.zeros((3, 8, 8))}, ValueError, "64 normals face away"),
        ({"source": "g.png"}, ValueError, "unknown format"),
        ({"source": "none.npy"}, FileNotFoundError, "none.npy"),
        ({"out": np.zeros((8, 9))}, ValueError, r"out \(8, 9\)"),
        ({"out": "z.png"}, ValueError, "unknown format"),
        ({"tile": 0}, ValueError, "tile=0"),
        ({"memory": 10}, ValueError, "holds not one row"),
        ({"convention": "x"}, ValueError, "'x' is unknown"),
    ],
)
def test_bad_arguments(change, error, match, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = {"source": np.zeros((2, 8, 8)), "out": np.zeros((8, 8))} | change
    with pytest.raises(error, match=match):
        large.integrate(arguments.pop("source"), arguments.pop("out"), **arguments)
    assert not list(tmp_path.iterdir())


def test_from_the_command_line(tmp_path, capsys):
    from torchdls.cli.main import main

    np.save(tmp_path / "g.npy", field(100, 90, np.float32))
    arguments = ["integrate", str(tmp_path / "g.npy"), "-o", str(tmp_path / "z.tiff"), "--tile", "64"]
    assert main([*arguments, "--method", "least_squares"]) == 0
    assert "100 x 90 pixels" in capsys.readouterr().out
    found = io.load_height(tmp_path / "z.tiff").height[0, 0].numpy()
    np.testing.assert_allclose(found, whole(np.load(tmp_path / "g.npy")), rtol=0, atol=1e-4)
    assert main(arguments) == 2
    assert "--tile: least_squares alone" in capsys.readouterr().err
    assert main([*arguments, "--method", "least_squares", "--force", "--mask", "m.png"]) == 2
    assert "--mask" in capsys.readouterr().err
