"""Writing under adversity: links, permissions, rivals, a full disk, a killed writer."""

import os
import resource
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdls import io
from torchdls._files import atomic_file

ROOT = Path(__file__).resolve().parents[2]


def write(path, content=b"new", overwrite=False):
    with atomic_file(path, overwrite) as file:
        file.write(content)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_link_stays_a_link_and_its_target_is_replaced(tmp_path):
    (tmp_path / "data").mkdir()
    target, link = tmp_path / "data" / "z.npy", tmp_path / "link.npy"
    target.write_bytes(b"old")
    link.symlink_to(target)
    with pytest.raises(FileExistsError):
        write(link)
    write(link, overwrite=True)
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert names(tmp_path / "data") == ["z.npy"]


def test_a_link_to_nothing_is_a_file_that_exists(tmp_path):
    link = tmp_path / "link.npy"
    link.symlink_to(tmp_path / "later.npy")
    with pytest.raises(FileExistsError):
        write(link)
    write(link, overwrite=True)
    assert link.is_symlink()
    assert (tmp_path / "later.npy").read_bytes() == b"new"
    link.unlink()
    link.symlink_to(tmp_path / "none" / "later.npy")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        write(link, overwrite=True)


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_permissions_are_kept(tmp_path, mode):
    path = tmp_path / "z.npy"
    path.write_bytes(b"old")
    path.chmod(mode)
    write(path, overwrite=True)
    assert stat.S_IMODE(path.stat().st_mode) == mode
    (tmp_path / "plain").write_bytes(b"")
    write(tmp_path / "fresh")
    assert (tmp_path / "fresh").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("links", [True, False])
def test_of_many_writers_exactly_one_wins(tmp_path, monkeypatch, links):
    def no_links(*paths):
        raise PermissionError(1, "no hard links here")

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    ready, won, lost = threading.Barrier(8), [], []

    def rival(number):
        try:
            with atomic_file(tmp_path / "z.bin") as file:
                file.write(b"%d" % number)
                ready.wait()
            won.append(b"%d" % number)
        except FileExistsError as error:
            lost.append(str(error))

    threads = [threading.Thread(target=rival, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert len(lost) == 7
    assert (tmp_path / "z.bin").read_bytes() == won[0]
    assert names(tmp_path) == ["z.bin"]
    assert all("z.bin: exists already" in message for message in lost)


@pytest.mark.slow
def test_what_a_killed_writer_left_is_swept_up_and_a_living_one_is_not_disturbed(tmp_path):
    code = f"""
import os, signal
from torchdls._files import atomic_file
with atomic_file({str(tmp_path / "z.npy")!r}) as file:
    file.write(b"half"); file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert killed.returncode == -signal.SIGKILL
    (draft,) = tmp_path.iterdir()
    assert draft.name.startswith(".z.npy.")
    write(tmp_path / "other.npy")
    assert draft.exists()
    with atomic_file(tmp_path / "z.npy", overwrite=True) as file:
        assert draft.read_bytes() == b""
        file.write(b"slow")
        write(tmp_path / "z.npy", b"quick")  # sweeps, but not the draft that is being written
        assert (tmp_path / "z.npy").read_bytes() == b"quick"
    assert (tmp_path / "z.npy").read_bytes() == b"slow"
    assert names(tmp_path) == ["other.npy", "z.npy"]


@pytest.mark.parametrize("suffix", ["npz", "npy", "tiff", "png", "ply", "obj", "stl", "glb"])
def test_a_full_disk_is_one_error_that_names_the_file(tmp_path, suffix):
    height, path = torch.rand(200, 200), tmp_path / f"z.{suffix}"
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        with pytest.raises(OSError, match=rf"z\.{suffix}") as caught:
            io.save_height(path, height)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert caught.value.filename == str(path) or str(caught.value).startswith(str(path))
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_written_names_the_file(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied", str(arguments[0]))

    monkeypatch.setattr("builtins.open", refuse)
    with pytest.raises(PermissionError) as caught:
        write(tmp_path / "z.npy")
    assert caught.value.filename == str(tmp_path / "z.npy")
    monkeypatch.undo()
    assert names(tmp_path) == []
    np.save(tmp_path / "z.npy", np.zeros((3, 3)))
    assert os.path.getsize(tmp_path / "z.npy") > 0
