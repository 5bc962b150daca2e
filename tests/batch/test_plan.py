"""Which maps are found, what their results are called, and what is refused before any work."""

import os

import numpy as np
import pytest
from PIL import Image

from torchdls.batch import Source, find_maps, folder_source, listed_maps, plan


@pytest.fixture
def tree(tmp_path):
    for name in ("a.png", "b/c.npy", "b/mask.png", "b/.hidden.png", "d/normal_map.png", "d/mask.png", "d/K.txt",
                 "d/other.png", "e/normal_map.exr", "notes.md", ".git/x.png", "out/a.npy"):  # fmt: skip
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
    return tmp_path


def names(found):
    return [name for name, _ in found]


def test_a_folder_is_walked(tree):
    found = find_maps([str(tree)], leave_out=str(tree / "out"))
    assert sorted(names(found)) == ["a", "b/c", "d", "e"]
    d = dict(found)["d"]
    assert d == Source(str(tree / "d/normal_map.png"), str(tree / "d/mask.png"), str(tree / "d/K.txt"))
    assert dict(found)["e"] == Source(str(tree / "e/normal_map.exr"))


def test_files_patterns_and_one_map(tree):
    assert find_maps([str(tree / "a.png")]) == [("a", Source(str(tree / "a.png")))]
    assert names(find_maps([str(tree / "d")])) == ["d"]
    assert names(find_maps([str(tree / "*" / "*.npy")])) == ["b/c", "out/a"]
    assert names(find_maps([str(tree / "[de]")])) == ["d", "e"]
    assert names(find_maps([str(tree / "**" / "*.png")])) == ["a", "d/normal_map", "d/other"]


def test_a_list(tree):
    assert names(listed_maps([f"{tree}/a.png\n", "\n", f"{tree}/b/c.npy\n", f"{tree}/d\n"])) == ["a", "b/c", "d"]
    with pytest.raises(ValueError, match="empty"):
        listed_maps(["\n"])
    with pytest.raises(ValueError, match="without normal_map"):
        listed_maps([f"{tree}/b"])


def test_what_is_not_there(tree):
    with pytest.raises(FileNotFoundError):
        find_maps([str(tree / "none.png")])
    with pytest.raises(FileNotFoundError, match="matches no file"):
        find_maps([str(tree / "*.tga")])
    with pytest.raises(FileNotFoundError, match="matches no map"):
        find_maps([str(tree / "*.md")])
    (tree / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no map"):
        find_maps([str(tree / "empty")])
    (tree / "d" / "normal_map.npy").write_bytes(b"")
    with pytest.raises(ValueError, match=r"normal_map.npy and normal_map.png"):
        folder_source(tree / "d")
    assert folder_source(tree / "b") is None


def test_two_results_of_one_name(tree):
    (tree / "b" / "c.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"c\.npy and .*c\.png: both results would be called c\.npz"):
        plan(find_maps([str(tree / "b")]), "out", [".npz"])
    with pytest.raises(ValueError, match="would replace an input"):
        plan(find_maps([str(tree / "b" / "c.npy")]), str(tree / "b"), [".npy"])
    jobs = plan(find_maps([str(tree / "a.png"), str(tree / "d")]), "out", [".npz", ".ply"])
    assert [job.outputs for job in jobs] == [
        (os.path.join("out", "a.npz"), os.path.join("out", "a.ply")),
        (os.path.join("out", "d.npz"), os.path.join("out", "d.ply")),
    ]


def test_a_folder_is_read_with_its_mask_and_camera(tmp_path):
    from torchdls.batch import Manner, read_map

    mask = np.zeros((8, 9), bool)
    mask[2:6, 3:8] = True
    Image.fromarray(np.full((8, 9, 3), (128, 128, 255), np.uint8)).save(tmp_path / "normal_map.png")
    Image.fromarray(mask).save(tmp_path / "mask.png")
    np.savetxt(tmp_path / "K.txt", [[50.0, 0, 4], [0, 50, 3.5], [0, 0, 1]])
    found = read_map(folder_source(tmp_path), Manner())
    np.testing.assert_array_equal(found.mask[0, 0], mask)
    assert found.camera[0, 2] == 4
    assert read_map(folder_source(tmp_path), Manner(own_camera=False)).camera is None
