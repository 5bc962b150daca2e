"""`torchdls photometric` from the outside: folders in, normals and surfaces out."""

import kornia
import numpy as np
import pytest
import torch
from PIL import Image

from tests.cli.test_cli import fails
from tests.photometric.test_lights import ball
from torchdls import (
    SURFACES,
    dlnv_normals,
    gradient_to_normals,
    io,
    load_field,
    load_photographs,
    render,
    ring_of_lights,
    rmse,
    save_normals,
    slope_noise,
    woodham,
)
from torchdls.cli.main import main

LIGHTS = ring_of_lights(6, dtype=torch.float64)


def write(path, picture):
    codes = (picture.clamp(0, 1) * 65535).round().numpy().astype(np.uint16)
    kornia.io.write_image(path, torch.from_numpy(codes)[None].expand(3, -1, -1).contiguous())


@pytest.fixture
def folder(tmp_path):
    surface = SURFACES["peaks"](32, dtype=torch.float64)
    images = render(gradient_to_normals(surface.gradient), LIGHTS, 0.8)[0]
    place = tmp_path / "photographs"
    place.mkdir()
    for k, image in enumerate(images):
        write(place / f"light{k + 7}.png", image)  # light10 comes after light9
    np.savetxt(place / "lights.txt", LIGHTS.numpy())
    return place


def test_a_folder_becomes_a_surface_and_a_normal_map(folder, tmp_path, capsys):
    out, normals = tmp_path / "z.npz", tmp_path / "n.png"
    arguments = ["photometric", folder, "-o", out, "-o", tmp_path / "z.ply", "--normals", normals]
    assert main([str(a) for a in [*arguments, "--integrator", "least_squares"]]) == 0
    told = capsys.readouterr().out
    assert "6 pictures of 32 x 32, lights from file" in told
    assert "woodham, least_squares: 1024 of 1024 pixels in " in told
    surface = SURFACES["peaks"](32, dtype=torch.float64)
    assert rmse(io.load_height(out).height.double(), surface.height) < 0.05 * surface.height.std()
    field = load_field(normals)
    expected = gradient_to_normals(surface.gradient)
    assert (field.values.double() - expected)[..., 2:-2, 2:-2].abs().mean() < 0.01
    assert main([str(a) for a in [*arguments, "--force", "--refine", "--method", "dlnv", "--quiet"]]) == 0
    assert capsys.readouterr().out == ""
    assert main(["photometric", str(folder), "-o", str(tmp_path / "slope_dls.npz")]) == 0
    assert " in the slopes, in " in capsys.readouterr().out
    assert main(["photometric", str(folder), "--normals", str(tmp_path / "alone.png")]) == 0
    assert "\nwoodham: 1024 of 1024 pixels in " in capsys.readouterr().out


def test_files_hold_albedo_confidence_and_the_noise_of_the_normals(folder, tmp_path):
    """Those of the method itself, and enough to weigh slopes by their own noise."""
    out, normals = tmp_path / "z.npz", tmp_path / "n.npz"
    arguments = ["photometric", folder, "-o", out, "--normals", normals, "--quiet", "--integrator", "least_squares"]
    assert main([str(a) for a in arguments]) == 0
    found = woodham(load_photographs(folder).images, LIGHTS.float())
    for path in (out, normals):
        with np.load(path) as held:
            for name in ("albedo", "confidence", "covariance"):
                np.testing.assert_allclose(held[name], getattr(found, name)[0].squeeze(0).numpy(), rtol=1e-5)
            values = torch.from_numpy(held["normals"])[None]
            weight = slope_noise(values, torch.from_numpy(held["covariance"])[None]).weight
            assert (weight > 0).all()


def test_options_of_the_method(folder, tmp_path, capsys):
    out = tmp_path / "n.npy"
    call = ["photometric", folder, "--normals", out, "--method", "dlnv", "--quiet"]
    assert main([str(a) for a in [*call, "--method-set", "n_iter=1", "--method-set", "lam=0.1"]]) == 0
    expected = dlnv_normals(load_photographs(folder).images, LIGHTS.float(), n_iter=1, lam=0.1).normals[0]
    np.testing.assert_allclose(np.load(out), expected.numpy(), atol=1e-6)
    assert "dlnv has no option 'degree'" in fails(capsys, *call, "--force", "--method-set", "degree=2")
    assert "lam=much given, a number" in fails(capsys, *call, "--force", "--method-set", "lam=much")
    assert "--method-set: 'lam' given" in fails(capsys, *call, "--force", "--method-set", "lam")


def test_lights_may_come_from_a_ball_and_intensities_from_a_file(folder, tmp_path):
    (folder / "lights.txt").unlink()
    strengths = np.array([1.0, 0.5, 0.8, 1.0, 0.7, 0.9])
    np.savetxt(folder / "light_intensities.txt", strengths)
    images = load_photographs(folder).images[0].double() * torch.from_numpy(strengths)[:, None, None]
    for k, light in enumerate(LIGHTS):
        picture, disk = ball(light, n=64, radius=25.0, centre=(32.0, 30.0))
        write(
            folder / f"light{k + 7}.png",
            torch.cat([torch.nn.functional.pad(images[k], (0, 0, 16, 16)), picture], 1) * strengths[k],
        )
    whole = torch.cat([torch.zeros(64, 32, dtype=torch.bool), disk], 1)
    Image.fromarray((whole.numpy() * 255).astype(np.uint8)).save(folder / "ball_mask.png")
    thing = torch.zeros(64, 96, dtype=torch.bool)
    thing[16:48, :32] = True
    Image.fromarray((thing.numpy() * 255).astype(np.uint8)).save(folder / "mask.png")
    out = tmp_path / "z.npy"
    assert main(["photometric", str(folder), "-o", str(out), "--integrator", "least_squares", "--quiet"]) == 0
    height = io.load_height(out).height[..., 16:48, :32].double()
    surface = SURFACES["peaks"](32, dtype=torch.float64).height
    assert rmse(height, surface) < 0.1 * surface.std()
    assert np.isnan(np.load(out)[:, 32:]).all()


def test_what_is_wrong_is_one_line(folder, tmp_path, capsys):
    out = tmp_path / "z.npy"
    assert "nothing to write" in fails(capsys, "photometric", folder)
    assert "--method: 'magic' is unknown" in fails(capsys, "photometric", folder, "-o", out, "--method", "magic")
    assert "--integrator: 'magic' is unknown" in fails(
        capsys, "photometric", folder, "-o", out, "--integrator", "magic"
    )
    assert "no such folder" in fails(capsys, "photometric", tmp_path / "nowhere", "-o", out)
    assert "holds 0 pictures" in fails(capsys, "photometric", tmp_path, "-o", out)
    np.savetxt(folder / "lights.txt", LIGHTS[:5].numpy())
    assert "lights.txt: holds numbers (5, 3), (6, 3)" in fails(capsys, "photometric", folder, "-o", out)
    np.savetxt(folder / "lights.txt", -LIGHTS.numpy())
    assert "not in front of the surface" in fails(capsys, "photometric", folder, "-o", out)
    (folder / "lights.txt").write_text("one two three")
    assert "lights.txt" in fails(capsys, "photometric", folder, "-o", out)
    (folder / "lights.txt").unlink()
    assert "no ball_mask.png" in fails(capsys, "photometric", folder, "-o", out)
    np.savetxt(folder / "lights.txt", LIGHTS.numpy())
    (folder / "filenames.txt").write_text("light7.png\nlight99.png\nlight8.png\n")
    assert "names light99.png, which is not there" in fails(capsys, "photometric", folder, "-o", out)
    (folder / "filenames.txt").unlink()
    write(folder / "light8.png", torch.zeros(5, 6))
    assert "light8.png: size (5, 6) differs" in fails(capsys, "photometric", folder, "-o", out)
    assert not out.exists()


@pytest.mark.parametrize("suffix", [".png", ".npy", ".npz"])
@pytest.mark.parametrize("convention", ["opengl", "directx"])
def test_normal_maps_come_back(tmp_path, suffix, convention):
    normals = gradient_to_normals(SURFACES["peaks"](16).gradient)
    mask = torch.ones(1, 1, 16, 16, dtype=torch.bool)
    mask[..., :3, :3] = False
    path = tmp_path / f"n{suffix}"
    save_normals(path, normals, mask=mask, convention=convention)
    values = load_field(path).values
    y = 1 if convention == "opengl" else -1
    expected = torch.where(mask, normals * torch.tensor([1.0, y, 1]).view(1, 3, 1, 1), 0)
    torch.testing.assert_close(torch.where(mask, values, 0), expected, rtol=0, atol=2e-5)
    with pytest.raises(FileExistsError):
        save_normals(path, normals)
    with pytest.raises(ValueError, match="normals"):
        save_normals(tmp_path / "other.npy", normals[:, :2])
