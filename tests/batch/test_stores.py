"""Object stores: the store in memory of fsspec, and local files by their URL."""

import numpy as np
import pytest

from tests.helpers.maps import contents, slopes, write_map, write_maps
from torchdls.batch import find_maps
from torchdls.batch.stores import exists, placed
from torchdls.cli.main import main

fsspec = pytest.importorskip("fsspec")
LS = ("--method", "least_squares", "--quiet", "--workers", "0")


@pytest.fixture
def store(tmp_path):
    """Maps in memory://maps, and the same in a folder."""
    write_maps(tmp_path / "in" / "more", [(32, 32), (20, 24)])
    write_map(tmp_path / "in" / "one" / "normal_map.png", slopes(16, 20))
    np.savetxt(tmp_path / "in" / "one" / "K.txt", [[60.0, 0, 10], [0, 60, 8], [0, 0, 1]])
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path / "in"), "/maps", recursive=True)
    yield memory
    for top in ("/maps", "/out"):
        if memory.exists(top):
            memory.rm(top, recursive=True)


def test_from_a_store_to_a_store(store, tmp_path, capsys):
    assert [name for name, _ in find_maps(["memory://maps"])] == ["more/m000", "more/m001", "one"]
    state = ("--state", str(tmp_path / "state"))
    arguments = ["batch", "memory://maps", "--out", "memory://out", *LS]
    assert main(arguments) == 2
    assert "--state" in capsys.readouterr().err
    assert main([*arguments, *state]) == 0
    assert main(["batch", str(tmp_path / "in"), "--out", str(tmp_path / "local"), *LS]) == 0
    assert sorted(store.find("/out")) == ["/out/more/m000.npz", "/out/more/m001.npz", "/out/one.npz"]
    store.get("/out", str(tmp_path / "fetched"), recursive=True)
    assert contents(tmp_path / "fetched") == contents(tmp_path / "local")
    report = tmp_path / "state" / "report.jsonl"
    assert report.read_text().count('"done"') == 3
    assert main([*arguments, *state]) == 0
    assert report.read_text().count('"kept"') == 3


def test_a_bad_map_and_nothing(store, tmp_path, capsys):
    store.pipe_file("/maps/bad.png", b"nothing")
    out = str(tmp_path / "out")
    assert main(["batch", "memory://maps", "--out", out, *LS]) == 1
    assert len(contents(out)) == 3
    assert "bad.png: no PNG file" in capsys.readouterr().err
    assert main(["batch", "memory://none", "--out", out, *LS]) == 2
    assert "there is nothing of this name" in capsys.readouterr().err


def test_what_fails_is_not_published(store, tmp_path):
    with pytest.raises(RuntimeError), placed("memory://out/x.npy"):
        raise RuntimeError
    assert not exists("memory://out/x.npy")
    with placed("memory://out/x.npy") as here, open(here, "wb") as file:
        file.write(b"x")
    assert store.find("/out") == ["/out/x.npy"]
    with placed(f"{tmp_path}/a/b.npy") as here:
        assert here == f"{tmp_path}/a/b.npy"
    assert (tmp_path / "a").is_dir()
