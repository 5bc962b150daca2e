"""`-o view.html`, `-o preview.png` and `torchdls view` from the outside."""

import re

import numpy as np
import pytest
import torch
from PIL import Image

from tests.cli.test_cli import fails, surface
from torchdls import depth_to_points, gradient_to_normals, load_height, save_normals
from torchdls.cli import pictures
from torchdls.cli.main import main


def run(*arguments):
    assert main([str(a) for a in arguments]) == 0


@pytest.fixture
def gradient_file(tmp_path):
    gradient = surface(24).gradient[0].numpy()
    gradient[:, 5, 6] = 40.0  # one wild sample
    np.savez(tmp_path / "g.npz", gradient=gradient)
    return tmp_path / "g.npz"


def title(page):
    return re.search("<title>(.*?)</title>", page.read_text())[1]


def test_integrate_writes_pages_and_previews_beside_files(tmp_path, gradient_file):
    outs = [tmp_path / name for name in ("z.npz", "view.html", "preview.png", "z_preview.png", "z.png")]
    given = [part for out in outs for part in ("-o", out)]
    run("integrate", gradient_file, "--set", "robust=True", "--set", "recipe=quick", "--unit", "mm", "--quiet", *given)
    assert title(outs[1]) == "g.npz, slope_dls"
    assert "height (mm)" in outs[1].read_text()
    for out in outs[2:4]:
        with Image.open(out) as image:
            assert image.mode == "RGBA"
    assert load_height(outs[4]).height.shape == (1, 1, 24, 24)  # any other PNG holds heights
    with np.load(outs[0]) as file:  # what was distrusted lies beside the height, for `view`
        assert file["trust"][0, 5, 6] == 0
        assert file["trust"].mean() > 0.9
    run("view", outs[0], "-o", tmp_path / "again_preview.png")
    with pytest.raises(FileExistsError, match="exists already"):
        pictures.check_outputs([str(outs[1])], False)


def test_view_shows_depths_as_points_and_jumps(tmp_path, gradient_file):
    normals = gradient_to_normals(surface(24).gradient)
    save_normals(tmp_path / "n.png", normals)
    size = "40,40,11.5,11.5"
    run("integrate", tmp_path / "n.png", "--camera", size, "--method", "least_squares", "--quiet",
        "-o", tmp_path / "d.npz", "-o", tmp_path / "d_preview.png")  # fmt: skip
    shown = pictures.read_shown(str(tmp_path / "d.npz"))
    torch.testing.assert_close(shown.camera, torch.tensor([[40, 0, 11.5], [0, 40, 11.5], [0, 0, 1]]).double())
    assert shown.gradient.shape == (1, 2, 24, 24)
    run("view", tmp_path / "d.npz", "-o", tmp_path / "d.html", "-o", tmp_path / "e_preview.png")
    assert (tmp_path / "d_preview.png").stat().st_size == pytest.approx(
        (tmp_path / "e_preview.png").stat().st_size, rel=0.2
    )
    assert "height (geometric mean 1)" in (tmp_path / "d.html").read_text()
    run("integrate", gradient_file, "--method", "piecewise", "--quiet", "-o", tmp_path / "p.npz")
    assert pictures.read_shown(str(tmp_path / "p.npz")).jump.shape == (1, 2, 24, 24)


def test_only_what_the_mask_fills_is_shown():
    """Under a camera the points stay where they are."""
    depth, mask = torch.rand(1, 1, 9, 12) + 1, torch.zeros(1, 1, 9, 12, dtype=torch.bool)
    mask[..., 3:5, 0:4] = True
    camera = torch.tensor([[20.0, 0, 6], [0, 20, 4], [0, 0, 1]])
    gradient = torch.rand(1, 2, 9, 12)
    part = pictures._cropped(pictures.Shown(depth, mask, (1.0, 1.0), gradient, camera=camera))
    assert part.gradient.equal(gradient[..., 2:6, :5])
    assert part.mask.sum() == mask.sum()
    points = depth_to_points(depth, camera)[..., 2:6, :5]
    torch.testing.assert_close(depth_to_points(part.height, part.camera), points)


def test_view_opens_a_page(tmp_path, gradient_file, monkeypatch, capsys):
    run("integrate", gradient_file, "--method", "least_squares", "--quiet", "-o", tmp_path / "z.tiff")
    opened: list = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix: str(tmp_path))
    run("view", tmp_path / "z.tiff")
    assert opened == [(tmp_path / "z.html").as_uri()]
    assert "z.html" in capsys.readouterr().out
    assert title(tmp_path / "z.html") == "z.tiff"


def test_what_is_wrong_is_one_line(tmp_path, capsys):
    np.savez(tmp_path / "odd.npz", height=np.zeros((5, 6)), jump=np.zeros((2, 5, 5)))
    np.savez(tmp_path / "deep.npz", depth=np.ones((5, 6)))
    out = tmp_path / "view.html"
    assert "jump: shape (2, 5, 5) does not fit" in fails(capsys, "view", tmp_path / "odd.npz", "-o", out)
    assert "without the camera" in fails(capsys, "view", tmp_path / "deep.npz", "-o", out)
    assert "is no picture" in fails(capsys, "view", tmp_path / "odd.npz", "-o", tmp_path / "z.png")
    assert "preview.pdf: unknown format" in fails(capsys, "integrate", "x.npz", "-o", tmp_path / "preview.pdf")
    assert not out.exists()
