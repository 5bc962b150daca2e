"""Every packing of a normal map, with noise and backgrounds, against the normals of a sphere in closed form."""

from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from torchdls import io
from torchdls.geometry import normals_to_gradient
from torchdls.io.packing import CHANNELS, describe, unpack

DTYPES: dict[str, Any] = {
    "u8": np.uint8,
    "u16": np.uint16,
    "float": np.float32,
    "0..255": np.float32,
    "0..65535": np.float32,
}
SCALE = {"0..255": 255, "0..65535": 65535}


def sphere(radius=0.9, n=48):
    """Unit normals (n, n, 3) of a sphere seen from above, and where it is seen; radius 0.9 shows nearly half of it."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    inside = x**2 + y**2 < 0.95 * radius**2
    z = np.sqrt(np.clip(radius**2 - x**2 - y**2, 0, None))
    return np.stack([x, -y, z], -1) / radius, inside


def pack(kind, normals, inside):
    """Channels in [0, 1], signed ones for `xyz`."""
    c = (normals + 1) / 2
    x, y, z = (c[..., i] for i in range(3))
    one = np.ones_like(x)
    planes = {
        "rgb": [x, y, z],
        "rgba": [x, y, z, 1.0 * inside],
        "rgb, height in alpha": [x, y, z, 0.1 + 0.8 * normals[..., 2]],
        "rgz": [x, y, normals[..., 2]],
        "rg, blue 0": [x, y, 0 * one],
        "rg, blue 128": [x, y, 128 / 255 * one],
        "rg, blue 255": [x, y, one],
        "rg, two channels": [x, y],
        "ag": [one, y, one, x],
        "ag, blue is green": [one, y, y, x],
        "ag, red 0": [0 * one, y, 0 * one, x],
        "xyz": [normals[..., 0], normals[..., 1], normals[..., 2]],
    }
    return np.stack(planes[kind], -1)


KINDS = {
    "rgb": "rgb", "rgba": "rgba", "rgb, height in alpha": "rgb", "rgz": "rgz", "rg, blue 0": "rg", "rg, blue 128": "rg",
    "rg, blue 255": "rg", "rg, two channels": "rg", "ag": "ag", "ag, blue is green": "ag", "ag, red 0": "ag",
    "xyz": "xyz",
}  # fmt: skip


def stored(kind, form, noise=0.0, background=None, radius=0.9):
    """Channels as a file holds them; the true normals; where they are."""
    normals, inside = sphere(radius)
    c = pack(kind, normals, inside)
    rng = np.random.default_rng(1)
    c = c + noise * rng.normal(size=c.shape) * (1 if kind == "xyz" else 0.5)
    c[~inside, : min(3, c.shape[-1])] = background or 0.0
    c = c if kind == "xyz" else np.clip(c, 0, 1)
    if kind == "rgba":
        c[..., 3] = inside
    dtype = DTYPES[form]
    top = np.iinfo(dtype).max if dtype != np.float32 else SCALE.get(form, 1)
    return (np.rint(c * top) if dtype != np.float32 else c * top).astype(dtype), normals, inside


def files():
    forms = {"xyz": ["float"], "rg, two channels": ["u8", "u16"]}
    return [(kind, form) for kind in KINDS for form in forms.get(kind, DTYPES)]


@pytest.mark.parametrize("kind, form", files())
@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("radius", [0.9, 3.0])
def test_every_packing_is_found_and_gives_the_true_normals(kind, form, noise, radius):
    for background in (0.0, 0.5, 1.0):
        channels, normals, inside = stored(kind, form, noise, None if kind == "xyz" else background, radius)
        found = unpack(channels)
        assert found.packing == KINDS[kind]
        n = found.normals[inside]
        n = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-3)
        error = np.linalg.norm(n - normals[inside], axis=-1)
        step = {"u8": 1 / 255, "u16": 1e-4}.get(form, 1e-6)
        assert np.median(error) < 2 * step + 2 * noise
        if kind in ("rgb", "rgz") and background != 0.5 and radius < 1:
            assert not found.normals[~inside].any()
        assert (found.mask is None) == (kind != "rgba")


@pytest.mark.parametrize("background", [0.0, 1.0])
@pytest.mark.parametrize("scale", [1, 255])
def test_floats_on_black_or_white_give_the_true_slopes(tmp_path, background, scale):
    """The reading that was silently wrong: floats in [0, 1], or to 255, and a background that is no normal."""
    normals, inside = sphere(1.2)
    inside &= np.hypot(*np.mgrid[-1:1:48j, -1:1:48j]) < 0.8
    c = np.where(inside[..., None], (normals + 1) / 2, background) * scale
    np.save(tmp_path / "n.npy", np.moveaxis(c, -1, 0))
    found = normals_to_gradient(io.load_field(tmp_path / "n.npy").values)
    np.testing.assert_array_equal(found.mask[0, 0], inside)
    x, y, z = normals[inside].T
    np.testing.assert_allclose(found.gradient[0].numpy()[:, inside], [-x / z, y / z], atol=1e-9)


@pytest.mark.parametrize("packing", ["rgb", "rgz", "rg"])
def test_what_is_said_counts_and_not_the_guess(packing):
    channels, *_ = stored("rgb", "u8")
    found = unpack(channels, packing)
    assert found.packing == packing
    x, y, z = (channels[24, 30] / 255).tolist()
    last = {"rgb": 2 * z - 1, "rgz": z, "rg": np.sqrt(1 - (2 * x - 1) ** 2 - (2 * y - 1) ** 2)}[packing]
    n = np.array([2 * x - 1, 2 * y - 1, last])
    np.testing.assert_allclose(found.normals[24, 30], n / np.linalg.norm(n))


def test_alpha_is_read_as_it_is_said_to_be():
    channels, *_ = stored("rgb, height in alpha", "u8")
    assert unpack(channels).mask is None
    np.testing.assert_array_equal(unpack(channels, "rgba").mask, channels[..., 3] > 127.5)
    assert unpack(stored("rgba", "u8")[0], "rgb").mask is None


def test_two_channels_of_floats_are_a_gradient_unless_said_otherwise(tmp_path):
    channels, normals, inside = stored("rg, two channels", "float")
    np.save(tmp_path / "n.npy", np.moveaxis(channels, -1, 0))
    assert io.load_field(tmp_path / "n.npy").kind == "gradient"
    field = io.load_field(tmp_path / "n.npy", packing="rg")
    assert (field.kind, field.packing) == ("normals", "rg")
    np.testing.assert_allclose(field.values[0].permute(1, 2, 0).numpy()[inside], normals[inside], atol=2e-3)


@pytest.mark.parametrize("shape", [(40, 40, 3), (40, 40, 4), (40, 40, 2)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_vectors_without_a_length_are_no_normal_map(tmp_path, shape, dtype):
    codes = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype)
    tifffile.imwrite(tmp_path / "n.tiff", codes, photometric="rgb" if shape[-1] > 2 else "minisblack", planarconfig=1)
    with pytest.raises(ValueError, match=r"n\.tiff: the vectors have length 1 in none of the packings"):
        io.load_field(tmp_path / "n.tiff")


@pytest.mark.parametrize("value", [0, 127, 255])
def test_a_map_of_background_alone_holds_no_normal(tmp_path, value):
    Image.fromarray(np.full((8, 8, 3), value, np.uint8)).save(tmp_path / "n.png")
    with pytest.raises(ValueError, match=r"n\.png"):
        io.load_field(tmp_path / "n.png")


def test_packings_have_words_and_unknown_ones_are_refused():
    assert all(describe(name) for name in CHANNELS)
    channels, *_ = stored("rgb", "u8")
    with pytest.raises(ValueError, match="packing: 'bgr' is unknown; choose from rgb"):
        unpack(channels, "bgr")
    with pytest.raises(ValueError, match="'ag' needs 4 channels, the file has 3"):
        unpack(channels, "ag")
