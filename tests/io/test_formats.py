"""Every format that is read, written by other libraries, against the normals that went in."""

import struct
import sys
import zlib

import numpy as np
import OpenEXR
import pytest
import scipy.io
import tifffile
from PIL import Image

from torchdls import io
from torchdls.io.formats import read_file


def dome(h=24, w=32):
    """Unit normals (h, w, 3) of a sphere of radius 1.8 over [-1, 1]^2."""
    y, x = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j]
    return np.stack([x, -y, np.sqrt(3.24 - x**2 - y**2)], -1) / 1.8


def codes(dtype=np.uint8):
    return np.rint((dome() + 1) / 2 * np.iinfo(dtype).max).astype(dtype)


def write_exr(path, channels, compression=OpenEXR.ZIP_COMPRESSION):
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, planes).write(str(path))


def xyz(prefix="", names="XYZ", dtype=np.float32):
    return {prefix + name: dome()[..., i].astype(dtype) for i, name in enumerate(names)}


def assert_dome(path, atol, packing):
    field = io.load_field(path)
    assert (field.kind, field.packing) == ("normals", packing)
    np.testing.assert_allclose(field.values[0].permute(1, 2, 0).numpy(), dome(), atol=atol)


@pytest.mark.parametrize("suffix", ["bmp", "tga", "webp", "png", "tiff"])
def test_pictures_without_loss(tmp_path, suffix):
    path = tmp_path / f"n.{suffix}"
    Image.fromarray(codes()).save(path, **({"lossless": True} if suffix == "webp" else {}))
    assert_dome(path, 0.01, "rgb")
    assert io.load_mask(path).shape == (1, 1, 24, 32)


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_pictures_with_loss(tmp_path, suffix):
    Image.fromarray(codes()).save(tmp_path / f"n.{suffix}", quality=95)
    assert_dome(tmp_path / f"n.{suffix}", 0.08, "rgb")


def test_run_length_coded_tga_with_alpha(tmp_path):
    alpha = np.zeros((24, 32, 1), np.uint8)
    alpha[4:20] = 255
    Image.fromarray(np.concatenate([codes(), alpha], -1)).save(tmp_path / "n.tga", compression="tga_rle")
    assert_dome(tmp_path / "n.tga", 0.01, "rgba")
    np.testing.assert_array_equal(io.load_field(tmp_path / "n.tga").mask[0, 0], alpha[..., 0] > 0)


@pytest.mark.parametrize("compression", [None, "zlib", "lzw"])
@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_tiff_by_pixels_and_by_planes(tmp_path, dtype, planar, compression):
    stored = dome().astype(dtype) if dtype == np.float32 else codes(dtype)
    stored = stored if planar == "contig" else np.moveaxis(stored, -1, 0)
    options = {"photometric": "rgb", "planarconfig": planar, "compression": compression}
    tifffile.imwrite(tmp_path / "n.tiff", np.ascontiguousarray(stored), **options)
    assert_dome(tmp_path / "n.tiff", 0.01, "xyz" if dtype == np.float32 else "rgb")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("first", [False, True])
def test_codes_in_npy_and_npz(tmp_path, dtype, first):
    stored = np.moveaxis(codes(dtype), -1, 0) if first else codes(dtype)
    np.save(tmp_path / "n.npy", stored)
    np.savez_compressed(tmp_path / "n.npz", normals=stored)
    assert_dome(tmp_path / "n.npy", 0.01, "rgb")
    assert_dome(tmp_path / "n.npz", 0.01, "rgb")


@pytest.mark.parametrize("compression", [OpenEXR.NO_COMPRESSION, OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_with_signs(tmp_path, dtype, compression):
    write_exr(tmp_path / "n.exr", xyz(names="RGB", dtype=dtype), compression)
    assert_dome(tmp_path / "n.exr", 1e-3, "xyz")


def test_exr_packed_like_a_picture_with_alpha(tmp_path):
    alpha = np.zeros((24, 32), np.float32)
    alpha[:, 5:] = 1
    planes = {name: ((plane + 1) / 2).astype(np.float32) for name, plane in xyz(names="RGB").items()}
    write_exr(tmp_path / "n.exr", planes | {"A": alpha})
    assert_dome(tmp_path / "n.exr", 1e-5, "rgba")
    np.testing.assert_array_equal(io.load_field(tmp_path / "n.exr").mask[0, 0], alpha > 0)


def test_the_normal_pass_of_a_render_with_many_layers(tmp_path):
    color = {f"ViewLayer.Combined.{c}": np.full((24, 32), 0.3, np.float32) for c in "RGBA"}
    write_exr(tmp_path / "n.exr", color | xyz("ViewLayer.Normal."))
    assert_dome(tmp_path / "n.exr", 1e-6, "xyz")
    write_exr(tmp_path / "two.exr", color | xyz("position."))
    with pytest.raises(ValueError, match=r"two\.exr: .*several layers of x, y, z or r, g, b among its channels View"):
        io.load_field(tmp_path / "two.exr")


def test_an_exr_of_one_channel_is_a_mask(tmp_path):
    plane = np.zeros((24, 32), np.float32)
    plane[3:9] = 1
    write_exr(tmp_path / "m.exr", {"Y": plane})
    np.testing.assert_array_equal(io.load_mask(tmp_path / "m.exr")[0, 0], plane > 0)


@pytest.mark.parametrize("interlace, passes", [(0, 1), (1, 7)])
@pytest.mark.parametrize("size", [(13, 11), (3, 2), (1, 1)])
def test_sixteen_bits_of_colour_in_png_interlaced_or_not(tmp_path, interlace, passes, size):
    """A PNG put together by its specification: pass k holds every dy-th row and dx-th column from (y, x)."""
    codes = np.random.default_rng(0).integers(0, 65536, (*size, 3)).astype(">u2")
    starts = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    parts = [codes[y::dy, x::dx] for x, y, dx, dy in starts] if interlace else [codes]
    assert len(parts) == passes
    raw = b"".join(b"\0" + row.tobytes() for part in parts if part.size for row in part)

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", size[1], size[0], 16, 2, 0, 0, interlace)
    for name, data in (("n", raw), ("short", raw[:-1]), ("long", raw + b"\0"), ("filter", b"\7" + raw[1:])):
        content = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
        (tmp_path / f"{name}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    np.testing.assert_array_equal(read_file(tmp_path / "n.png", (".png",)), codes)
    for name in ("short", "long", "filter"):
        with pytest.raises(ValueError, match=rf"{name}\.png: cannot be read as PNG: its compressed data"):
            read_file(tmp_path / f"{name}.png", (".png",))


# --- MAT -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.uint8, np.uint16])
def test_mat_as_scipy_writes_it(tmp_path, compressed, dtype):
    stored = dome().astype(dtype) if np.dtype(dtype).kind == "f" else codes(dtype)
    other = {"title": "text", "cells": np.array([1, "a"], object), "k": 3.0, "mask": dome()[..., 0] > 0}
    scipy.io.savemat(tmp_path / "n.mat", {"Normal_gt": stored} | other, do_compression=compressed)
    assert_dome(tmp_path / "n.mat", 0.01, "xyz" if np.dtype(dtype).kind == "f" else "rgb")
    np.testing.assert_array_equal(io.load_field(tmp_path / "n.mat").mask[0, 0], other["mask"])


@pytest.mark.parametrize("compressed", [False, True])
def test_mat_values_equal_those_that_scipy_reads(tmp_path, compressed):
    rng = np.random.default_rng(0)
    arrays = {f"a{i}": (100 * rng.random((3, 4 + i, 2))).astype(t) for i, t in enumerate("bBhHiIfd")}
    arrays |= {"whole": np.arange(12.0).reshape(3, 4), "flags": rng.random((5, 3)) > 0.5, "empty": np.zeros((0, 3))}
    scipy.io.savemat(tmp_path / "a.mat", arrays, do_compression=compressed)
    theirs = scipy.io.loadmat(tmp_path / "a.mat")
    from torchdls.io.matlab import open_mat

    ours = open_mat(tmp_path / "a.mat")
    assert set(ours) == set(arrays)
    for name in arrays:
        np.testing.assert_array_equal(ours[name], theirs[name])


def test_mat_gradient_and_camera(tmp_path):
    gradient = np.random.default_rng(0).normal(size=(2, 6, 7))
    k = np.array([[500, 0, 32.5], [0, 510, 24], [0, 0, 1]])
    scipy.io.savemat(tmp_path / "g.mat", {"gradient": np.moveaxis(gradient, 0, -1), "K": k, "pixel_size": 0.5})
    field = io.load_field(tmp_path / "g.mat")
    assert (field.kind, field.pixel_size) == ("gradient", (0.5, 0.5))
    np.testing.assert_array_equal(field.values[0], gradient)
    np.testing.assert_array_equal(io.load_camera(tmp_path / "g.mat"), k)


def test_mat_that_does_not_say_which_array(tmp_path):
    scipy.io.savemat(tmp_path / "n.mat", {"a": dome(), "b": dome()})
    with pytest.raises(ValueError, match=r"n\.mat: holds a, b; gradient, normals, or one array"):
        io.load_field(tmp_path / "n.mat")
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    with pytest.raises(ValueError, match=r"new\.mat: .*version 7\.3; store it with"):
        io.load_field(tmp_path / "new.mat")


@pytest.mark.parametrize("suffix, module", [("exr", "OpenEXR"), ("tiff", "tifffile"), ("bmp", "PIL.Image")])
def test_a_missing_reader_names_the_extra(tmp_path, monkeypatch, suffix, module):
    start = {"exr": b"v/1\x01", "tiff": b"II*\0", "bmp": b"BM"}[suffix]
    (tmp_path / f"n.{suffix}").write_bytes(start + bytes(100))
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"{module} is not installed: pip install 'torchdls\[files\]'"):
        io.load_field(tmp_path / f"n.{suffix}")
