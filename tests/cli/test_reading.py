"""How a normal map is taken: its convention, what faces away, what is background, and what is said of it."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from torchdls import LeastSquares, gradient_to_normals, guess_convention, io, normals_to_gradient
from torchdls.cli.main import main
from torchdls.geometry import GRADIENT_CONVENTIONS, NORMAL_CONVENTIONS, convert_gradient, convert_normals
from torchdls.surfaces import SURFACES

FRONT = [name for name, axes in NORMAL_CONVENTIONS.items() if axes[2] == (2, 1)]  # their normals face the viewer


def first_alike(name):
    """The first convention that reads the same normals as this one, or as its mirror image in depth: no curl tells."""
    axes = NORMAL_CONVENTIONS[name][:2]
    mirror = tuple((index, -sign) for index, sign in axes)
    return next(other for other in FRONT if NORMAL_CONVENTIONS[other][:2] in (axes, mirror))


def terrain():
    """A twisted surface: its readings differ."""
    return SURFACES["peaks"](40, dtype=torch.float64)


def write(path, normals, noise=0.0, bits=8):
    n = normals[0].permute(1, 2, 0).numpy()
    n = n + noise * np.random.default_rng(0).normal(size=n.shape)
    if path.suffix == ".npy":
        np.save(path, n / np.linalg.norm(n, axis=-1, keepdims=True))
    else:
        Image.fromarray(np.rint(np.clip((n + 1) / 2, 0, 1) * 255).astype(np.uint8)).save(path)
    return path


def run(capsys, path, *options, status=0):
    out = path.with_name("z.npy")
    arguments = ["integrate", str(path), "--method", "least_squares", "-o", str(out), "--force", *options]
    assert main(arguments) == status
    return capsys.readouterr()


@pytest.mark.parametrize("true", FRONT)
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_auto_takes_the_reading_that_is_a_surface(tmp_path, capsys, true, noise):
    s = terrain()
    path = write(tmp_path / "n.npy", gradient_to_normals(s.gradient, true), noise)
    said = run(capsys, path, "--convention", "auto")
    assert said.err == ""
    height, exact = io.load_height(tmp_path / "z.npy").height, LeastSquares()(s.gradient)
    # The sign of the height cannot be told from its normals: directx and kornia are mirror images in depth.
    error = min(float((sign * height - exact).std()) for sign in (1, -1))
    assert error < (0.25 if noise else 1e-5) * float(exact.std())
    assert f"convention {first_alike(true)}" in said.out


def test_auto_takes_normals_that_point_into_the_picture(tmp_path, capsys):
    s = terrain()
    path = write(tmp_path / "n.npy", gradient_to_normals(s.gradient, "opencv"))
    assert "convention opencv" in run(capsys, path, "--convention", "auto").out
    torch.testing.assert_close(io.load_height(tmp_path / "z.npy").height, LeastSquares()(s.gradient))


@pytest.mark.parametrize("true", FRONT)
@pytest.mark.parametrize("read", FRONT)
def test_a_wrong_reading_is_one_line_of_warning_that_names_the_right_one(tmp_path, capsys, true, read):
    path = write(tmp_path / "n.png", gradient_to_normals(terrain().gradient, true))
    lines = run(capsys, path, "--convention", read, "--quiet").err.splitlines()
    if first_alike(true) == first_alike(read):  # equally integrable
        assert lines == []
        return
    assert len(lines) == 1
    assert lines[0].startswith(f"torchdls: warning: {path}: under convention {first_alike(true)!r} the normals are ")
    assert f"--convention {first_alike(true)} or auto" in lines[0]


@pytest.mark.parametrize("name", ["sphere", "bowl", "saddle", "plane", "noise", "ridge"])
def test_no_warning_where_the_usual_reading_is_as_good(tmp_path, capsys, name):
    """Surfaces whose twist z_xy is small, where a ratio of noise to noise would decide."""
    y, x = np.mgrid[-1:1:48j, -1:1:48j] * 10.0
    z = {
        "sphere": np.sqrt(30.0**2 - x**2 - y**2),
        "bowl": (x**2 + y**2) / 20,
        "saddle": (x**2 - y**2) / 20,
        "plane": 0.3 * x - 0.2 * y,
        "noise": np.random.default_rng(0).normal(size=x.shape),
        "ridge": 3 * np.cos(x / 3),
    }[name]
    gradient = torch.from_numpy(np.stack(np.gradient(z, 20 / 47)[::-1]))[None]
    path = write(tmp_path / "n.png", gradient_to_normals(gradient))
    assert run(capsys, path, "--quiet").err == ""


def test_candidates_share_one_scale():
    """The saddle x^2 - y^2 is a surface in all three readings; its twist is noise alone, which must not decide."""
    candidates = ["opengl", "directx", "matlab"]
    y, x = np.mgrid[-1:1:40j, -1:1:40j]
    noise = 1e-3 * np.random.default_rng(0).normal(size=(2, 40, 40))
    plain = gradient_to_normals(torch.from_numpy(np.stack([x, -y]) + noise)[None])
    assert max(guess_convention(plain, candidates=candidates).residual.values()) < 0.1
    twisted = gradient_to_normals(torch.from_numpy(np.stack([y, x]) + noise)[None])
    residual = guess_convention(twisted, candidates=candidates).residual
    assert residual["opengl"] < 0.1 < 0.9 < residual["directx"]


@pytest.mark.parametrize("as_read, holds", [("opengl", "opencv"), ("kornia", "opencv"), ("opencv", "opengl")])
def test_normals_that_face_away_are_an_error_that_names_the_way_out(tmp_path, capsys, as_read, holds):
    path = write(tmp_path / "n.png", gradient_to_normals(terrain().gradient, holds))
    message = run(capsys, path, "--convention", as_read, status=2).err
    assert message.count("\n") == 1
    assert f"100% of the normals face away from the viewer under convention '{as_read}'" in message
    facing = "opencv" if holds == "opencv" else " and ".join(FRONT)
    assert f"they face it under {facing}: --convention {holds}" in message


def test_only_the_mask_decides_what_faces_away(tmp_path, capsys):
    n = gradient_to_normals(terrain().gradient)
    n[..., :, :30] *= -1
    path = write(tmp_path / "n.npy", n)
    assert "75% of the normals face away" in run(capsys, path, status=2).err
    mask = np.zeros((40, 40), bool)
    mask[:, 29:] = True
    np.save(tmp_path / "m.npy", mask)
    said = run(capsys, path, "--mask", str(tmp_path / "m.npy"))
    assert said.err == f"{path}: 40 normals that face away or lie at grazing angle are left out\n"


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_background_is_counted_as_background(tmp_path, capsys, value):
    n = gradient_to_normals(terrain().gradient)
    n[..., :5, :7] = value
    n[..., 20, 20] *= -1
    np.save(tmp_path / "n.npy", n)
    background, away = run(capsys, tmp_path / "n.npy").err.splitlines()
    assert background.endswith("n.npy: 35 pixels of background are left out")
    assert away.endswith("n.npy: 1 normals that face away or lie at grazing angle are left out")


def test_a_camera_decides_what_faces_it(tmp_path, capsys):
    """A plane seen so steeply from the side that its normal points away from the axis, but not from the camera."""
    n = torch.tensor([-0.995, 0.0, 0.0999], dtype=torch.float64)
    n = (n / n.norm())[None, :, None, None].expand(1, 3, 20, 20)
    path = tmp_path / "n.npy"
    np.save(path, n)
    said = run(capsys, path, "--convention", "opencv", "--camera", "20,20,-30,10", status=0)
    assert "convention opencv" in said.out
    assert "face away" in run(capsys, path, "--convention", "opencv", status=2).err


def test_what_is_read_is_said_and_can_be_said(tmp_path, capsys):
    path = write(tmp_path / "n.png", gradient_to_normals(terrain().gradient))
    assert run(capsys, path).out.startswith(f"{path}: read as rgb (x, y, z = 2 c - 1), convention opengl\n")
    said = run(capsys, path, "--channels", "rg").out
    assert said.startswith(f"{path}: read as rg (x, y = 2 c - 1, z from the length 1, blue is not read)")
    assert "choose from rgb" in run(capsys, path, "--channels", "bgr", status=2).err
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (30, 30, 3), np.uint8)).save(tmp_path / "noise.png")
    message = run(capsys, tmp_path / "noise.png", status=2).err
    assert "the vectors have length 1 in none of the packings" in message
    assert "--channels" in message


def test_a_new_convention_is_one_entry_of_the_table(tmp_path, capsys, monkeypatch):
    """What reads, writes, guesses, lists and refuses finds it there, and only there."""
    normals = gradient_to_normals(terrain().gradient)
    turned = torch.stack([-normals[:, 1], -normals[:, 0], normals[:, 2]], 1)  # x down the rows, y to the left
    with monkeypatch.context() as patch:
        patch.setitem(NORMAL_CONVENTIONS, "turned", ((1, -1), (0, -1), (2, 1)))
        torch.testing.assert_close(normals_to_gradient(turned, "turned").gradient, terrain().gradient)
        torch.testing.assert_close(gradient_to_normals(terrain().gradient, "turned"), turned)
        torch.testing.assert_close(convert_normals(turned, "turned", "opengl"), normals)
        assert guess_convention(turned, candidates=list(NORMAL_CONVENTIONS)).convention == "turned"
        path = write(tmp_path / "n.npy", turned)
        assert "convention turned" in run(capsys, path, "--convention", "auto").out
        assert "convention turned" in run(capsys, path, "--convention", "turned").out
        assert "turned" in run(capsys, path, "--convention", "none", status=2).err
        assert ", turned, or auto" in help_of_integrate(capsys)
    assert "turned" not in run(capsys, path, "--convention", "none", status=2).err
    with pytest.raises(ValueError, match="'turned' is unknown; choose from opengl"):
        normals_to_gradient(turned, "turned")


def test_a_new_gradient_convention_is_one_entry_of_the_table(tmp_path, capsys, monkeypatch):
    gradient, path = terrain().gradient, tmp_path / "g.npy"
    np.save(path, -gradient[0].flip(0).numpy())
    monkeypatch.setitem(GRADIENT_CONVENTIONS, "turned", ((1, -1), (0, -1)))
    run(capsys, path, "--convention", "turned")
    torch.testing.assert_close(io.load_height(tmp_path / "z.npy").height, LeastSquares()(gradient))
    torch.testing.assert_close(convert_gradient(-gradient.flip(1), "turned"), gradient)
    assert "turned; by default" in help_of_integrate(capsys)


def help_of_integrate(capsys):
    with pytest.raises(SystemExit):
        main(["integrate", "--help"])
    return " ".join(capsys.readouterr().out.split())


def test_the_help_names_all_conventions_without_loading_torch():
    code = "import sys; from torchdls.cli.main import main\ntry: main(['integrate', '--help'])\n"
    code += "finally: print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout
    assert found.rstrip().endswith("False")
    assert all(name in found for name in (*NORMAL_CONVENTIONS, *GRADIENT_CONVENTIONS))


def test_every_convention_is_tried():
    n = gradient_to_normals(terrain().gradient)
    for name in NORMAL_CONVENTIONS:
        turned = convert_normals(n, target=name)
        guess = guess_convention(turned, candidates=list(NORMAL_CONVENTIONS))
        assert guess.residual[name] == min(guess.residual.values())


@pytest.mark.parametrize("perspective", [False, True])
def test_a_large_map_is_judged_by_tiles_as_it_is_as_a_whole(perspective):
    from torchdls.io.reading import _tiles

    k = torch.tensor([[900.0, 0, 300], [0, 900, 200], [0, 0, 1]], dtype=torch.float64) if perspective else None
    y, x = torch.meshgrid(*(torch.arange(d, dtype=torch.float64) for d in (400, 520)), indexing="ij")
    u = 0.02 * torch.sin(x / 40) * torch.cos(y / 30)
    gradient = torch.stack([torch.gradient(u, dim=d)[0] for d in (1, 0)])[None] * (1 if perspective else 50)
    normals = gradient_to_normals(gradient, "directx" if k is None else "opencv", camera=k)
    mask = (x < 450)[None, None]
    tiles = _tiles(normals, mask, k, size=64, most=9)
    assert tiles[0].shape == (9, 3, 64, 64)
    candidates = ["opencv"] if perspective else FRONT
    guess = guess_convention(tiles[0], tiles[1], candidates, camera=tiles[2])
    whole = guess_convention(normals, mask, candidates, camera=k)
    assert guess.convention == whole.convention
    for name in candidates:
        assert guess.residual[name] == pytest.approx(whole.residual[name], abs=0.2)


# --- what is wrong with the options --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        (["--set", "tol=abc"], "--set: tol=abc given, a number is needed (default: 1e-06)"),
        (["--set", "tol=[1]"], "--set: tol=[1] given, a number is needed (default: 1e-06)"),
        (["--set", "tol=None"], "--set: tol=None given, a number is needed (default: 1e-06)"),
        (["--set", "tol=(1,2)"], "--set: tol=(1, 2) given, which is not usable (default: 1e-06)"),
        (["--set", "foo=1"], "least_squares has no option 'foo'; its options and their defaults: tol=1e-06, max_iter"),
        (["--set", "pixel_size=2"], "--set: pixel_size has an option of its own, --pixel-size"),
        (["--method", "slope_dls", "--set", "sigma=abc"], "--set: sigma=abc given, which is not usable"),
        (["--method", "slope_dls", "--set", "robust=perhaps"], "--set: robust=perhaps given, True or False is needed"),
        (
            ["--method", "slope_dls", "--set", "patch_sizes=3.5"],
            "patch_sizes=3.5 given, integers of at least 2 are needed",
        ),
        (["--method", "magic"], "--method: 'magic' is unknown; choose from least_squares"),
        (["--camera", "1,2,3"], "--camera: '1,2,3' given, a file or four numbers FX,FY,CX,CY are needed"),
        (["--camera", "1,2,3,4,5"], "--camera: '1,2,3,4,5' given, a file or four numbers"),
        (["--camera", "none.txt"], "none.txt: No such file or directory"),
    ],
)
def test_a_wrong_option_is_said_before_any_file_is_read(tmp_path, capsys, options, message):
    arguments = ["integrate", str(tmp_path / "absent.png"), "--method", "least_squares", *options]
    assert main([*arguments, "-o", str(tmp_path / "z.npy")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("torchdls: error: ")
    assert message in error
    assert error.count("\n") == 1
    for python in ("<class", "NoneType", "instances", "Traceback", "__", "object is not", "Error"):
        assert python not in error


@pytest.mark.parametrize("method", ["dls", "slope_dls", "huber", "spectral_regularization", "mumford_shah"])
def test_no_value_of_any_option_lets_python_speak(tmp_path, capsys, method):
    from torchdls import INTEGRATORS

    for name in INTEGRATORS.parameters(method):
        for value in ("abc", "[1]", "None", "{'a': 1}", "1e999", "-1", "(1, 2)", "'"):
            arguments = ["integrate", str(tmp_path / "absent.npy"), "--method", method, "--set", f"{name}={value}"]
            assert main([*arguments, "-o", str(tmp_path / "z.npy")]) == 2
            error = capsys.readouterr().err
            assert error.count("\n") == 1
            for python in ("<class", "NoneType", "instances of", "__", "object is not", "unhashable", "dtype"):
                assert python not in error


def test_memory_that_is_not_there_is_one_line(monkeypatch, tmp_path, capsys):
    def exhaust(*arguments, **options):
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:75] DefaultCPUAllocator: can't allocate memory: you tried")

    monkeypatch.setattr(io, "load_field", exhaust)
    assert main(["integrate", "n.npy", "-o", str(tmp_path / "z.npy")]) == 2
    assert capsys.readouterr().err == "torchdls: error: there is not enough memory for an input of this size\n"
