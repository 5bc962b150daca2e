"""Damaged heights, masks and cameras, and numbers that are none."""

import random

import numpy as np
import pytest
import torch
from PIL import Image

from torchdls import io


def test_damaged_heights_masks_and_cameras_are_one_error_that_names_the_file(tmp_path, capfd):
    for suffix in ("npz", "npy", "tiff", "png"):
        io.save_height(tmp_path / f"z.{suffix}", torch.rand(20, 30))
    Image.fromarray(np.eye(20, 30) > 0).save(tmp_path / "m.png")
    np.savetxt(tmp_path / "k.txt", np.eye(3))
    readers = {"z": io.load_height, "m": io.load_mask, "k": io.load_camera}
    whole, rng, said = sorted(tmp_path.iterdir()), random.Random(3), []
    for number in range(200):
        source = whole[number % len(whole)]
        content, path = bytearray(source.read_bytes()), tmp_path / f"bad{number}{source.suffix}"
        if number % 3:
            for _ in range(rng.choice([1, 3, 20])):
                content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        path.write_bytes(content if number % 3 else content[: rng.randrange(len(content))])
        try:
            readers[source.stem](path)
        except ValueError as error:
            said.append((str(error), str(path)))
    assert len(said) > 100
    assert all(message.startswith(path) and "\n" not in message for message, path in said)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


@pytest.mark.parametrize(
    "text, good", [("1 0 2\n0 1 3  # row\n\n0 0 1", True), ("1 2 3", False), ("1 2\n3 x", False), ("1 2\n3", False)]
)
def test_a_camera_is_three_rows_of_three(tmp_path, text, good):
    (tmp_path / "k.txt").write_text(text)
    if good:
        np.testing.assert_array_equal(io.load_camera(tmp_path / "k.txt"), [[1, 0, 2], [0, 1, 3], [0, 0, 1]])
        return
    with pytest.raises(ValueError, match=r"k\.txt: .*are needed"):
        io.load_camera(tmp_path / "k.txt")


@pytest.mark.parametrize("value", [[1.0, -1.0], [np.nan, 1.0], [1.0, 2.0, 3.0], []])
def test_a_pixel_size_that_is_none(tmp_path, value):
    np.savez(tmp_path / "g.npz", gradient=np.zeros((2, 3, 4)), pixel_size=np.array(value))
    with pytest.raises(
        ValueError, match=r"g\.npz: pixel_size: .* given, one or two positive numbers are needed"
    ) as caught:
        io.load_field(tmp_path / "g.npz")
    assert "array" not in str(caught.value)
