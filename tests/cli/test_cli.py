"""The command line from the outside: files in, files out, one line on standard error, exit status."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchdls import LeastSquares, Piecewise, gradient_to_normals, io, normals_to_gradient, reconstruct, rmse
from torchdls.cli.main import main
from torchdls.geometry import GRADIENT_CONVENTIONS, NORMAL_CONVENTIONS
from torchdls.surfaces import SURFACES

ROOT = Path(__file__).resolve().parents[2]


def surface(n=32):
    return SURFACES["peaks"](n, dtype=torch.float64)


def write_map(path, normals, bits=8):
    top = 2**bits - 1
    codes = np.rint((normals[0].permute(1, 2, 0).numpy() + 1) / 2 * top)
    if bits == 8:
        Image.fromarray(codes.astype(np.uint8)).save(path)
    else:
        import kornia

        kornia.io.write_image(path, torch.from_numpy(codes.astype(np.uint16)).permute(2, 0, 1).contiguous())


@pytest.fixture
def gradient_file(tmp_path):
    path = tmp_path / "gradient.npz"
    np.savez(path, gradient=surface().gradient[0].numpy())
    return path


def fails(capsys, *arguments):
    """Status 2 and exactly one line on standard error, which is returned."""
    assert main([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("torchdls: error: ")
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    return captured.err


# --- help ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [["--help"], ["integrate", "--help"], ["--version"]])
def test_help_does_not_import_torch(arguments):
    code = f"""
import sys
from torchdls.cli import main
try:
    main({arguments!r})
except SystemExit as stop:
    assert not stop.code
heavy = {{"torch", "numpy", "kornia", "matplotlib", "plotly", "trimesh"}} & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "torchdls" in done.stdout


def test_module_runs_as_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "torchdls", "integrate"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "usage: torchdls integrate" in done.stderr


def test_methods_lists_the_registry(capsys):
    from torchdls.integrators import INTEGRATORS

    assert main(["methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    methods = [line for line in lines if not line.startswith(" ")]
    assert [line.split()[0] for line in methods] == list(INTEGRATORS)
    assert all(len(line.split()) > 3 for line in methods)
    found = " ".join(lines)
    assert found.count("pixel_size=1.0") == len(INTEGRATORS)
    assert "tol=1e-06, max_iter=500" in found


# --- integrate -----------------------------------------------------------------------------------------------------


def test_gradient_by_least_squares(tmp_path, gradient_file, capsys):
    out = tmp_path / "z.npy"
    assert main(["integrate", str(gradient_file), "--method", "least_squares", "-o", str(out)]) == 0
    torch.testing.assert_close(io.load_height(out).height, LeastSquares()(surface().gradient))
    assert "least_squares: 32 x 32 pixels" in capsys.readouterr().out


@pytest.mark.parametrize("convention", NORMAL_CONVENTIONS)
@pytest.mark.parametrize("bits", [8, 16])
def test_normal_maps_in_every_convention(tmp_path, convention, bits):
    s, out = surface(), tmp_path / "z.npy"
    write_map(tmp_path / "n.png", gradient_to_normals(s.gradient, convention), bits)
    arguments = ["integrate", str(tmp_path / "n.png"), "--convention", convention, "--method", "least_squares"]
    assert main([*arguments, "--quiet", "--float64", "-o", str(out)]) == 0
    exact = LeastSquares()(s.gradient)
    steep = float(s.gradient.abs().max())
    error = float(rmse(io.load_height(out).height, exact))
    assert error < {8: 0.05, 16: 0.0002}[bits] * (1 + steep) ** 2


@pytest.mark.parametrize("convention", GRADIENT_CONVENTIONS)
def test_gradient_conventions(tmp_path, convention):
    g = surface().gradient[0].numpy()
    stored = np.empty_like(g)
    for component, (index, sign) in zip(g, GRADIENT_CONVENTIONS[convention], strict=True):
        stored[index] = sign * component
    np.save(tmp_path / "g.npy", stored)
    arguments = ["integrate", str(tmp_path / "g.npy"), "--convention", convention, "--method", "least_squares"]
    assert main([*arguments, "--quiet", "-o", str(tmp_path / "z.npy")]) == 0
    torch.testing.assert_close(io.load_height(tmp_path / "z.npy").height, LeastSquares()(surface().gradient))


def test_every_output_format_at_once_with_mask_and_pixel_size(tmp_path, gradient_file):
    mask = np.ones((32, 32), bool)
    mask[:, :5] = False
    Image.fromarray(mask).save(tmp_path / "mask.png")
    outs = [tmp_path / f"z.{s}" for s in ("npz", "npy", "tiff", "png", "ply", "obj", "stl", "glb")]
    arguments = ["integrate", gradient_file, "--method", "least_squares", "--mask", tmp_path / "mask.png"]
    arguments += ["--pixel-size", "2", "0.5", *(part for out in outs for part in ("-o", out))]
    assert main([str(a) for a in arguments]) == 0
    exact = LeastSquares(pixel_size=(2.0, 0.5))(surface().gradient, mask=torch.from_numpy(mask)[None, None])
    for out in outs[:4]:
        height = io.load_height(out)
        np.testing.assert_array_equal(height.mask[0, 0], mask)
        torch.testing.assert_close(
            height.height[height.mask].double(), exact[height.mask], rtol=0, atol=1e-4 * float(exact.abs().max())
        )
    assert io.load_height(outs[0]).pixel_size == (2.0, 0.5)
    assert all(out.stat().st_size > 0 for out in outs)


def test_invalid_pixels_are_reported_and_left_out(tmp_path, capsys):
    n = gradient_to_normals(surface().gradient)
    n[..., :4, :4] = -1  # black
    write_map(tmp_path / "n.png", n)
    out = tmp_path / "z.npz"
    assert main(["integrate", str(tmp_path / "n.png"), "--method", "least_squares", "-o", str(out)]) == 0
    assert "16 pixels of background are left out" in capsys.readouterr().err
    height = io.load_height(out)
    assert height.height[..., :4, :4].isnan().all()
    assert int((~height.mask).sum()) == 16


@pytest.mark.parametrize("as_file", [False, True])
def test_perspective_plane_comes_back_as_depth(tmp_path, as_file):
    k = torch.tensor([[60.0, 0, 15], [0, 60, 15], [0, 0, 1]], dtype=torch.float64)
    n = torch.tensor([0.2, -0.3, -1.0], dtype=torch.float64)[None, :, None, None].expand(1, 3, 32, 32)
    np.savetxt(tmp_path / "k.txt", k.numpy())
    np.save(tmp_path / "n.npy", n)
    outs = [str(tmp_path / "z.npz"), str(tmp_path / "z.ply")]
    camera = str(tmp_path / "k.txt") if as_file else "60,60,15,15"
    arguments = ["integrate", str(tmp_path / "n.npy"), "--convention", "opencv", "--camera", camera, "--quiet"]
    assert main([*arguments, "--method", "least_squares", "-o", outs[0], "-o", outs[1]]) == 0
    v, u = np.mgrid[:32, :32]
    exact = 1 / (1 - (0.2 * (u - 15) - 0.3 * (v - 15)) / 60)
    depth = np.load(outs[0])["depth"]
    np.testing.assert_allclose(depth / depth.mean(), exact / exact.mean(), rtol=2e-4)
    import trimesh

    mesh = trimesh.load_mesh(outs[1])
    normals = mesh.face_normals * [1, -1, -1]  # back to the camera's frame
    np.testing.assert_allclose(normals, np.broadcast_to(n[0, :, 0, 0] / n[0, :, 0, 0].norm(), normals.shape), atol=0.01)


def test_known_and_coarse_depths_and_the_focal_length_reach_the_method(tmp_path, capsys):
    k = torch.tensor([[60.0, 0, 8], [0, 60, 8], [0, 0, 1]], dtype=torch.float64)
    surface = SURFACES["sphere"](16, dtype=torch.float64)
    np.save(tmp_path / "n.npy", gradient_to_normals(surface.gradient / 60, "opencv", camera=k))
    np.savetxt(tmp_path / "k.txt", k.numpy())
    depth = np.exp(surface.height[0, 0].numpy() / 60)
    np.save(tmp_path / "coarse.npy", 7 * depth + 2)
    sparse = np.zeros_like(depth)
    sparse[4, 5] = 3.0
    np.save(tmp_path / "sparse.npy", sparse)
    asked = [
        "integrate",
        str(tmp_path / "n.npy"),
        "--convention",
        "opencv",
        "--camera",
        str(tmp_path / "k.txt"),
        "--quiet",
    ]

    def depth_of(name, *options, method="least_squares"):
        out = str(tmp_path / name)
        assert main([*asked, "--method", method, *options, "-o", out]) == 0
        return np.load(out)

    for name, known in (("a.npy", "5,4,3"), ("b.npy", str(tmp_path / "sparse.npy"))):
        assert abs(depth_of(name, "--known", known)[4, 5] - 3) < 1e-6
    assert abs(np.median(depth_of("c.npy", "--known", "2.5")) - 2.5) < 0.01
    fitted = depth_of("d.npy", "--coarse", str(tmp_path / "coarse.npy"))
    np.testing.assert_allclose(fitted / fitted.mean(), depth / depth.mean(), rtol=2e-3)
    told = depth_of("e.npy", method="piecewise")
    made = reconstruct(gradient_to_normals(surface.gradient / 60, camera=k), camera=k, method=Piecewise(60.0)).depth
    np.testing.assert_allclose(told, made[0, 0].numpy(), rtol=1e-5)
    assert main([*asked, "--known", "99,4,3", "-o", str(tmp_path / "f.npy")]) == 2
    assert "--known: '99,4,3' given" in capsys.readouterr().err


def test_dls_with_options_and_a_progress_bar(tmp_path, gradient_file, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    out = str(tmp_path / "z.npy")
    options = ["--set", "n_iter=3", "--set", "tol=0", "--set", "height_step=proximal"]
    assert main(["integrate", str(gradient_file), "--method", "dls", *options, "-o", out]) == 0
    captured = capsys.readouterr()
    assert "objective" in captured.err
    assert "3/3" in captured.err
    from torchdls import DLS

    torch.testing.assert_close(
        io.load_height(out).height, DLS(n_iter=3, tol=0, height_step="proximal")(surface().gradient)
    )


def test_a_stored_mask_and_that_of_the_option_both_count(tmp_path):
    stored, given = np.ones((32, 32), bool), np.ones((32, 32), bool)
    stored[0], given[:, 0] = False, False
    np.savez(tmp_path / "g.npz", gradient=surface().gradient[0].numpy(), mask=stored, weight=np.ones((32, 32)))
    np.save(tmp_path / "m.npy", given)
    arguments = ["integrate", str(tmp_path / "g.npz"), "--mask", str(tmp_path / "m.npy"), "--method", "least_squares"]
    assert main([*arguments, "-o", str(tmp_path / "z.npy")]) == 0
    np.testing.assert_array_equal(io.load_height(tmp_path / "z.npy").mask[0, 0], stored & given)


# --- bad input -----------------------------------------------------------------------------------------------------


def test_a_bad_file_gives_one_line_and_no_output(tmp_path, capsys):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    out = tmp_path / "z.ply"
    assert "bad.png" in fails(capsys, "integrate", tmp_path / "bad.png", "-o", out)
    assert "none.png: No such file" in fails(capsys, "integrate", tmp_path / "none.png", "-o", out)
    assert "none: no such file or folder" in fails(capsys, "integrate", tmp_path / "none", "-o", out)
    assert "of photographs: torchdls photometric" in fails(capsys, "integrate", tmp_path, "-o", out)
    assert [p.name for p in tmp_path.iterdir()] == ["bad.png"]


def test_existing_output_needs_force(tmp_path, capsys, gradient_file):
    out = tmp_path / "z.npy"
    out.write_bytes(b"mine")
    arguments = ["integrate", gradient_file, "--method", "least_squares", "-o", out]
    assert "--force" in fails(capsys, *arguments)
    assert out.read_bytes() == b"mine"
    assert main([*map(str, arguments), "--force"]) == 0
    assert io.load_height(out).height.shape == (1, 1, 32, 32)


@pytest.mark.parametrize(
    "extra, match",
    [
        (["--method", "magic"], "'magic' is unknown; choose from least_squares, "),
        (["--convention", "opengl"], "'opengl' is not for gradient; choose from image"),
        (["--pixel-size", "0"], "pixel_size: 0.0"),
        (["--pixel-size", "1", "2", "3"], "3 numbers given"),
        (["--camera", "1,2,3,4"], "needs a normal map"),
        (["--camera", "1,2,3,x"], "four numbers FX,FY,CX,CY"),
        (["--set", "lam"], "NAME=VALUE"),
        (["--set", "colour=3"], "colour"),
        (["--set", "n_iter=-1"], "n_iter"),
        (["-o", "none/z.npy"], "does not exist"),
        (["-o", "z.xyz"], "unknown format"),
    ],
)
def test_bad_arguments(tmp_path, capsys, gradient_file, extra, match):
    assert match in fails(capsys, "integrate", gradient_file, "-o", tmp_path / "z.npy", *extra)
    assert [p.name for p in tmp_path.iterdir()] == ["gradient.npz"]


def test_inputs_that_cannot_be_integrated(tmp_path, capsys, gradient_file):
    out = tmp_path / "z.npy"
    np.save(tmp_path / "batch.npy", np.zeros((2, 2, 8, 8)))
    np.save(tmp_path / "nan.npy", np.full((2, 8, 8), np.nan))
    np.save(tmp_path / "away.npy", np.tile([[[0.0]], [[0.0]], [[-1.0]]], (1, 8, 8)))
    np.save(tmp_path / "mask.npy", np.ones((8, 9), bool))
    assert "2 surfaces" in fails(capsys, "integrate", tmp_path / "batch.npy", "-o", out)
    assert "no finite slope" in fails(capsys, "integrate", tmp_path / "nan.npy", "-o", out)
    assert "100% of the normals face away" in fails(capsys, "integrate", tmp_path / "away.npy", "-o", out)
    assert "sizes must agree" in fails(capsys, "integrate", gradient_file, "--mask", tmp_path / "mask.npy", "-o", out)
    assert not out.exists()


def test_an_interrupt_is_quiet(monkeypatch, tmp_path, gradient_file, capsys):
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(io, "save_height", stop)
    arguments = ["integrate", str(gradient_file), "--method", "least_squares", "-o", str(tmp_path / "z.npy")]
    assert main(arguments) == 130
    assert capsys.readouterr().err == "torchdls: interrupted\n"


# --- demo ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_demo_leaves_everything_it_promises(tmp_path, capsys):
    folder = tmp_path / "new" / "demo"
    assert main(["demo", "--out", str(folder), "--size", "40", "--quiet"]) == 0
    table = capsys.readouterr().out.splitlines()
    assert table[0].split() == ["surface", "SNR", "method", "RMSE", "SSIM", "angle", "seconds"]
    assert [line.split()[:2] for line in table[1:7]] == [["Tent", "1dB"]] * 3 + [["Terrain", "0dB"]] * 3
    names = {f"{s}.{e}" for s in ("tent", "terrain") for e in ("png", "html")}
    methods = ("least_squares", "dls", "slope_dls")
    names |= {f"{s}_{m}.{e}" for s in ("tent", "terrain") for m in methods for e in ("npz", "ply")}
    assert {p.name for p in folder.iterdir()} == names
    with np.load(folder / "tent_dls.npz") as file:
        assert {"height", "mask", "gradient", "truth", "snr_db"} <= set(file.files)
        tent = SURFACES["tent"](40)
        torch.testing.assert_close(torch.from_numpy(file["truth"]), tent.height[0, 0])
        error = rmse(torch.from_numpy(file["height"])[None, None], tent.height)
    assert float(table[2].split()[3]) == pytest.approx(float(error), abs=1e-4)
    assert main(["integrate", str(folder / "tent_dls.npz"), "-o", str(folder / "again.npy"), "--quiet"]) == 0


def test_a_normal_map_reads_as_the_library_reads_it(tmp_path):
    """The round trip by hand: what the command integrates is what `normals_to_gradient` gives for the decoded file."""
    write_map(tmp_path / "n.png", gradient_to_normals(surface().gradient), 16)
    gradient = normals_to_gradient(io.load_field(tmp_path / "n.png").values).gradient
    main(["integrate", str(tmp_path / "n.png"), "--method", "least_squares", "-o", str(tmp_path / "z.npz"), "--quiet"])
    assert io.load_field(tmp_path / "z.npz").values.equal(gradient)


def test_the_default_method_tells_the_noise_it_found(tmp_path, gradient_file, capsys):
    assert main(["integrate", str(gradient_file), "-o", str(tmp_path / "z.npz")]) == 0
    line = capsys.readouterr().out
    assert line.startswith("slope_dls: ")
    assert "noise " in line
