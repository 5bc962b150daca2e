"""Damaged files: one line on standard error that names the file, status 2, no output, little memory."""

import contextlib
import io as text_io
import random
import resource
import signal
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import scipy.io
import tifffile
import torch
from PIL import Image

from torchdls.cli.main import main

ROOT = Path(__file__).resolve().parents[2]


def good_files(folder):
    """A dome in every format, and in every way of coding that has a decoder of its own."""
    import kornia

    y, x = np.mgrid[-1:1:32j, -1:1:32j]
    n = np.stack([x, -y, np.sqrt(3.24 - x**2 - y**2)], -1) / 1.8
    codes, fine = (np.rint((n + 1) / 2 * top).astype(t) for top, t in ((255, np.uint8), (65535, np.uint16)))
    picture = Image.fromarray(codes)
    for suffix in ("png", "jpg", "bmp", "tga", "webp"):
        picture.save(folder / f"a.{suffix}")
    picture.convert("P", palette=Image.Palette.ADAPTIVE).save(folder / "palette.png")
    picture.save(folder / "runs.tga", compression="tga_rle")
    kornia.io.write_image(folder / "fine.png", torch.from_numpy(np.ascontiguousarray(np.moveaxis(fine, -1, 0))))
    tifffile.imwrite(folder / "a.tiff", codes, photometric="rgb")
    tifffile.imwrite(folder / "zlib.tiff", fine, photometric="rgb", compression="zlib")
    planes = np.ascontiguousarray(np.moveaxis(fine, -1, 0))
    tifffile.imwrite(folder / "planes.tiff", planes, photometric="rgb", planarconfig="separate")
    np.save(folder / "a.npy", np.moveaxis(n, -1, 0))
    np.savez(folder / "a.npz", normals=n)
    np.savez_compressed(folder / "packed.npz", normals=n, mask=x > -2)
    scipy.io.savemat(folder / "a.mat", {"normals": n})
    scipy.io.savemat(folder / "packed.mat", {"Normal_gt": n}, do_compression=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": n.astype(np.float32)}).write(str(folder / "a.exr"))
    return sorted(folder.iterdir())


def damage(content, rng, others):
    """One of six kinds of harm."""
    b, kind = bytearray(content), rng.choice(["cut", "bits", "header", "hole", "other", "large"])
    if kind == "cut":
        del b[rng.randrange(len(b)) :]
    elif kind == "bits":
        for _ in range(rng.choice([1, 3, 30])):
            b[rng.randrange(len(b))] ^= 1 << rng.randrange(8)
    elif kind == "header":
        for _ in range(rng.choice([1, 2, 5])):
            b[rng.randrange(min(len(b), 200))] = rng.randrange(256)
    elif kind == "hole":
        start = rng.randrange(len(b))
        b[start : start + 200] = bytes(len(b[start : start + 200]))
    elif kind == "large":
        start = rng.randrange(min(len(b), 400))
        b[start : start + 4] = b"\xff\xff\xff\x7f"
    else:
        b = bytearray(rng.choice(others).read_bytes())
    return bytes(b)


def run(path, out):
    error, output = text_io.StringIO(), text_io.StringIO()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(output):
        status = main(["integrate", str(path), "--method", "least_squares", "-o", str(out)])
    return status, error.getvalue(), output.getvalue()


def test_three_hundred_damaged_files(tmp_path, capfd):
    (tmp_path / "good").mkdir()
    good, rng, refused = good_files(tmp_path / "good"), random.Random(11), 0
    for number in range(300):
        whole = good[number % len(good)]
        path, out = tmp_path / f"bad{number}{whole.suffix}", tmp_path / f"z{number}.npy"
        path.write_bytes(damage(whole.read_bytes(), rng, good))
        status, error, output = run(path, out)
        if status == 0:  # harm that no reader can see, such as another colour of a pixel
            assert out.exists()
            continue
        refused += 1
        assert status == 2
        assert error.startswith("torchdls: error: ")
        assert error.count("\n") == 1
        assert str(path) in error
        assert error[:-1].isprintable()
        assert output == ""
        assert not out.exists()
    assert refused > 150
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""  # nothing that a decoder wrote past Python
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_the_whole_files_are_read(tmp_path):
    (tmp_path / "good").mkdir()
    for path in good_files(tmp_path / "good"):
        status, error, output = run(path, tmp_path / f"{path.name}.npy")
        assert (status, error) == (0, "")
        assert f"{path}: read as " in output


def npy_header(shape):
    header = text_io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return header.getvalue()


def png(width, height, depth):
    """A PNG whose checksums are right and whose size is a lie."""
    chunk = lambda kind, body: struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))  # noqa: E731
    header = struct.pack(">IIBBBBB", width, height, depth, 2, 0, 0, 0)
    data = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def liars(folder):
    """Small files that declare tens of gigabytes, and an NPZ that holds a large array nobody asks for."""
    (folder / "huge.npy").write_bytes(npy_header((3, 70000, 70000)) + bytes(100))
    (folder / "fine.png").write_bytes(png(60000, 60000, 16))
    (folder / "coarse.png").write_bytes(png(13000, 13000, 8))
    with zipfile.ZipFile(folder / "huge.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("normals.npy", npy_header((3, 70000, 70000)) + bytes(100))
    with zipfile.ZipFile(folder / "text.npz", "w") as archive:
        archive.writestr("normals.npy", b"no array")
    return sorted(folder.iterdir())


LINUX = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
# The peak of this program alone: ru_maxrss would remember that of the process it was forked from.
LIMITED = """
import sys
from torchdls.cli.main import main
status = main(sys.argv[1:])
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
sys.exit(status)
"""


def limited(*arguments, code=LIMITED):
    """Status, standard error, and the peak memory in MB of a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stderr, int(done.stdout.split()[-1]) / 1024


@LINUX
@pytest.mark.slow
@pytest.mark.parametrize("name", ["huge.npy", "fine.png", "coarse.png", "huge.npz", "text.npz"])
def test_a_header_is_not_believed(tmp_path, name):
    liars(tmp_path)
    status, error, memory = limited("integrate", tmp_path / name, "-o", tmp_path / "z.npy")
    assert status == 2
    assert error.count("\n") == 1
    assert str(tmp_path / name) in error
    assert memory < 500
    assert not (tmp_path / "z.npy").exists()


@LINUX
@pytest.mark.slow
def test_three_hundred_damaged_files_need_little_memory(tmp_path):
    (tmp_path / "good").mkdir()
    good, rng, paths = good_files(tmp_path / "good"), random.Random(11), []
    for number in range(300):
        whole = good[number % len(good)]
        paths.append(tmp_path / f"bad{number}{whole.suffix}")
        paths[-1].write_bytes(damage(whole.read_bytes(), rng, good))
    code = LIMITED.replace("main(sys.argv[1:])", "max(main([*sys.argv[1:4], path, '-o', path + '.npy']) "
                                                 "for path in sys.argv[4:])")  # fmt: skip
    status, error, memory = limited("integrate", "--method", "least_squares", *paths, code=code)
    assert status == 2
    assert 150 < error.count("\n") <= 300
    assert memory < 500


@LINUX
@pytest.mark.slow
def test_what_nobody_asks_for_is_not_unpacked(tmp_path):
    gradient = text_io.BytesIO()
    np.save(gradient, np.ones((2, 8, 8)))
    with zipfile.ZipFile(tmp_path / "g.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("gradient.npy", gradient.getvalue())
        with archive.open("video.npy", "w") as member:
            member.write(npy_header((200, 1000, 1000)))
            for _ in range(800):
                member.write(bytes(1_000_000))
    arguments = ["--method", "least_squares", "-o", tmp_path / "z.npy"]
    status, error, memory = limited("integrate", tmp_path / "g.npz", *arguments)
    assert (status, error) == (0, "")
    assert memory < 500


def test_a_full_disk_is_one_line(tmp_path):
    np.save(tmp_path / "g.npy", np.random.default_rng(0).normal(size=(2, 100, 100)))
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        status, error, output = run(tmp_path / "g.npy", tmp_path / "z.npz")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert status == 2
    assert error == f"torchdls: error: {tmp_path / 'z.npz'}: File too large\n"
    assert output == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["g.npy"]
