"""The tutorial's two paths, run as they are printed on data that is made here: files in, a mesh and pages out."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from tests.helpers.examples import write_normal_map, write_photographs
from torchdls.cli.main import main

TUTORIAL = Path(__file__).resolve().parents[1] / "docs" / "tutorial.md"


def commands(heading):
    """The commands under a heading, without the installation."""
    section = TUTORIAL.read_text(encoding="utf-8").partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    assert section, f"no heading {heading!r}"
    lines = "\n".join(re.findall(r"```console\n(.*?)```", section, re.DOTALL)).replace("\\\n", "").splitlines()
    assert all(line.startswith(("pip install", "torchdls ")) for line in lines)
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("torchdls")]


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def all_of(heading):
        found = commands(heading)
        assert 0 < len(found) <= 5
        for arguments in found:
            assert main(arguments) == 0, arguments

    return all_of


def vertices(path):
    mesh: Any = trimesh.load(path, process=False)
    return torch.from_numpy(np.asarray(mesh.vertices)).double()


def test_a_normal_map_with_mask_and_camera_becomes_a_mesh_and_a_page(run, tmp_path):
    depth, mask = write_normal_map(tmp_path / "relief", noise=0.01)
    run("A normal map with its mask and camera")
    found = -vertices(tmp_path / "relief.ply")[:, 2]
    assert found.shape == depth[mask].shape
    ratio = found / depth[mask]  # a normal map fixes a perspective surface up to one factor
    assert (ratio / ratio.mean() - 1).square().mean().sqrt() < 0.0005
    assert depth[mask].std() / depth[mask].mean() > 0.04
    assert "<title>" in (tmp_path / "relief.html").read_text()
    assert (tmp_path / "relief_preview.png").read_bytes().startswith(b"\x89PNG")


def test_ten_photographs_with_a_mirror_ball_become_a_mesh_and_a_page(run, tmp_path):
    height, mask = write_photographs(tmp_path / "photographs")
    run("Ten photographs and a mirror ball")
    found, height = vertices(tmp_path / "thing.ply")[:, 2], height[mask]
    assert found.shape == height.shape
    error = (found - found.mean()) - (height - height.mean())
    assert error.square().mean().sqrt() < 0.02 * height.std()
    assert "<title>" in (tmp_path / "thing.html").read_text()
    assert (tmp_path / "thing_preview.png").read_bytes().startswith(b"\x89PNG")
