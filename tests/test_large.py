"""Out of core: least squares equal to the whole, whatever the tiles, the file and the memory; SlopeDLS near to it."""

import os
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.ndimage import label

from tests.helpers.large import BLOCK, disk_ring_and_specks, field, whole
from torchdls import (
    DLS,
    ConvergenceWarning,
    GradientOperator,
    HarkerOLeary,
    Huber,
    LeastSquares,
    SlopeDLS,
    add_noise,
    convert_gradient,
    edge_slopes,
    gradient_to_normals,
    io,
    large,
    noise_level,
    rmse,
    shrink_slow_waves,
    solve,
)
from torchdls.integrators.slope_dls.runs import Grid, blended
from torchdls.integrators.slope_dls.waves import cautious
from torchdls.large.components import Parts
from torchdls.large.edges import Edges
from torchdls.large.files import Field
from torchdls.large.slope_dls import spans
from torchdls.large.transform import Passes
from torchdls.operators import dct2, idct2
from torchdls.surfaces import SURFACES


@pytest.mark.parametrize("size", [(100, 130), (65, 40), (1, 90), (90, 1), (33, 200)])
@pytest.mark.parametrize("tile", [1, 7, 64, 1000])
def test_equal_to_the_whole_for_any_tile(size, tile):
    g, found = field(*size), np.empty(size)
    result = large.integrate(g, found, tile=tile, pixel_size=(2.0, 0.5))
    np.testing.assert_allclose(found, whole(g, pixel_size=(2.0, 0.5)), rtol=0, atol=1e-10)
    assert result.shape == size
    assert result.passes == (-(-size[0] // tile), -(-size[1] // tile), -(-size[0] // tile))


def test_in_single_precision():
    g, found = field(150, 170, np.float32), np.empty((150, 170), np.float32)
    large.integrate(g, found, tile=32)
    exact = whole(g.astype(np.float64))
    assert np.abs(found - exact).max() < 3e-6 * np.ptp(exact)


@pytest.mark.parametrize("suffix", [".npy", ".tiff"])
def test_files_in_and_out(tmp_path, suffix):
    g = field(300, 280, np.float32)
    np.save(tmp_path / "g.npy", g)
    out = tmp_path / f"z{suffix}"
    large.integrate(tmp_path / "g.npy", out, tile=100)
    found = io.load_height(out).height[0, 0].numpy()
    np.testing.assert_allclose(found, whole(g), rtol=0, atol=1e-3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["g.npy", out.name]
    with pytest.raises(FileExistsError):
        large.integrate(tmp_path / "g.npy", out)
    large.integrate(tmp_path / "g.npy", out, overwrite=True, memory=2**20)
    np.testing.assert_allclose(io.load_height(out).height[0, 0].numpy(), found, rtol=0, atol=1e-3)
    if suffix == ".tiff":
        import tifffile

        with tifffile.TiffFile(out) as file:
            assert file.is_bigtiff
            assert file.pages[0].is_tiled


def test_zarr_in_and_out(tmp_path):
    zarr = pytest.importorskip("zarr")
    g = field(130, 90, np.float32)
    array = zarr.create_array(tmp_path / "g.zarr", shape=g.shape, dtype=g.dtype, chunks=(2, 64, 64))
    array[:] = g
    large.integrate(tmp_path / "g.zarr", tmp_path / "z.zarr", tile=50)
    np.testing.assert_allclose(zarr.open_array(tmp_path / "z.zarr", mode="r")[:], whole(g), rtol=0, atol=1e-4)


def test_a_tiff_in(tmp_path):
    import tifffile

    g = field(70, 90, np.float32)
    tifffile.imwrite(tmp_path / "g.tif", g, photometric="minisblack")
    found = np.empty((70, 90), np.float32)
    large.integrate(tmp_path / "g.tif", found, tile=30)
    np.testing.assert_allclose(found, whole(g), rtol=0, atol=1e-4)


@pytest.mark.parametrize("convention", ["opengl", "directx", "matlab"])
def test_normals(convention):
    g = torch.from_numpy(field(80, 70))
    normals = gradient_to_normals(g, convention).numpy()
    found = np.empty((80, 70))
    large.integrate(normals, found, tile=30, convention=convention)
    np.testing.assert_allclose(found, whole(g.numpy()), rtol=0, atol=1e-9)


def test_gradient_conventions():
    g = field(40, 50)
    found = np.empty((40, 50))
    large.integrate(g, found, tile=16, convention="depth")
    np.testing.assert_allclose(found, whole(convert_gradient(torch.from_numpy(g), "depth").numpy()), rtol=0, atol=1e-10)


def test_memory_says_how_much_at_once():
    class Watched:
        """An array that notes the largest part that was asked for."""

        def __init__(self, array):
            self.array, self.most, self.shape, self.dtype = array, 0, array.shape, array.dtype

        def __getitem__(self, part):
            found = self.array[part]
            self.most = max(self.most, found.nbytes)
            return found

    g, found = Watched(field(2000, 100, np.float32)), np.empty((2000, 100), np.float32)
    result = large.integrate(g, found, memory=2**21)
    assert result.tile == 2**21 // (16 * 4 * 2000)
    assert g.most <= 2 * 4 * 100 * (result.tile + 2)


@pytest.mark.parametrize(
    "change, error, match",
    [
        ({"source": np.zeros((1, 8, 8))}, ValueError, r"source \(1, 8, 8\)"),
        ({"source": np.zeros((2, 8, 8), int)}, TypeError, "floats are needed"),
        ({"source": np.full((2, 8, 8), np.nan)}, ValueError, "not finite in rows 0 to 7"),
        ({"source": np.zeros((3, 8, 8))}, ValueError, "64 normals face away"),
        ({"source": "g.png"}, ValueError, "unknown format"),
        ({"source": "none.npy"}, FileNotFoundError, "none.npy"),
        ({"out": np.zeros((8, 9))}, ValueError, r"out \(8, 9\)"),
        ({"out": "z.png"}, ValueError, "unknown format"),
        ({"tile": 0}, ValueError, "tile=0"),
        ({"halo": -1}, ValueError, "halo=-1"),
        ({"integrator": SlopeDLS(), "memory": 2**16}, ValueError, "holds no tile with a halo"),
        ({"memory": 10}, ValueError, "holds not one row"),
        ({"convention": "x"}, ValueError, "'x' is unknown"),
    ],
)
def test_bad_arguments(change, error, match, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = {"source": np.zeros((2, 8, 8)), "out": np.zeros((8, 8))} | change
    with pytest.raises(error, match=match):
        large.integrate(arguments.pop("source"), arguments.pop("out"), **arguments)
    assert not list(tmp_path.iterdir())


def test_from_the_command_line(tmp_path, capsys):
    from torchdls.cli.main import main

    np.save(tmp_path / "g.npy", field(100, 90, np.float32))
    arguments = ["integrate", str(tmp_path / "g.npy"), "-o", str(tmp_path / "z.tiff"), "--tile", "64"]
    assert main([*arguments, "--method", "least_squares"]) == 0
    assert "100 x 90 pixels" in capsys.readouterr().out
    found = io.load_height(tmp_path / "z.tiff").height[0, 0].numpy()
    np.testing.assert_allclose(found, whole(np.load(tmp_path / "g.npy")), rtol=0, atol=1e-4)
    assert main([*arguments, "--method", "l1"]) == 2
    assert "--tile: least_squares, slope_dls and dls alone" in capsys.readouterr().err
    assert main([*arguments, "--method", "dls", "--force"]) == 2
    assert "learner, select of DLS" in capsys.readouterr().err
    fixed = ["--set", "learn=fixed", "--set", "select=False", "--set", "n_iter=1"]
    assert main([*arguments, "--method", "dls", *fixed, "--force"]) == 0
    assert "noise" in capsys.readouterr().out
    assert main([*arguments, "--method", "slope_dls", "--set", "recipe=quick", "--force"]) == 0
    assert "noise" in capsys.readouterr().out
    tiled, expected = np.empty((100, 90), np.float32), np.load(tmp_path / "g.npy")
    large.integrate(expected, tiled, integrator=SlopeDLS(recipe="quick"), tile=64)
    np.testing.assert_array_equal(io.load_height(tmp_path / "z.tiff").height[0, 0].numpy(), tiled)
    assert main([*arguments, "--method", "least_squares", "--force", "--mask", "m.png"]) == 2
    assert "m.png: unknown format" in capsys.readouterr().err
    mask = disk_ring_and_specks(100, 90)
    np.save(tmp_path / "m.npy", mask)
    masked = [*arguments, "--method", "least_squares", "--force", "--mask", str(tmp_path / "m.npy")]
    assert main(masked) == 0
    found = io.load_height(tmp_path / "z.tiff").height[0, 0].numpy()
    exact = LeastSquares(tol=1e-9)(torch.from_numpy(expected).double(), torch.from_numpy(mask)[None])[0].numpy()
    assert np.abs(found - exact).max() < 1e-4 * np.ptp(exact)
    assert main([*masked, "--camera", "1,1,0,0"]) == 2
    assert "--camera" in capsys.readouterr().err


def smoothed(g, recipe, **options):
    return SlopeDLS(recipe=recipe, **options)(torch.from_numpy(np.ascontiguousarray(g)))[0].numpy()


@pytest.mark.parametrize(
    "options",
    [{"recipe": "quick"}, {"recipe": "quick", "guard": None, "sigma": 0.25}, {"recipe": "blend", "n_iter": 2}],
)
def test_one_tile_is_slope_dls(options):
    g, found = field(70, 90), np.empty((70, 90))
    whole_height = SlopeDLS(**options, pixel_size=(2.0, 0.5))(torch.from_numpy(g))[0].numpy()
    result = large.integrate(g, found, integrator=SlopeDLS(**options), pixel_size=(2.0, 0.5), tile=90, memory=2**18)
    np.testing.assert_allclose(found, whole_height, rtol=0, atol=1e-9)
    assert result.tiles == (1, 1)
    assert result.passes[0] > 1
    expected = options.get("sigma", float(noise_level(torch.from_numpy(g), pixel_size=(2.0, 0.5))))
    assert result.noise == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_slope_dls_by_tiles_is_near_the_whole():
    true = SURFACES["tent"](256, dtype=torch.float64)
    noisy = add_noise(true.gradient, 5, torch.Generator().manual_seed(0))
    g, found = noisy[0].numpy(), np.empty((256, 256))
    result = large.integrate(g, found, integrator=SlopeDLS(recipe="quick"), tile=96, halo=32)
    tiled, together, plain = (
        float(rmse(torch.from_numpy(z).view(1, 1, 256, 256), true.height))
        for z in (found, smoothed(g, "quick"), whole(g))
    )
    assert result.tiles == (2, 2)
    assert tiled < 1.05 * together < 0.6 * plain


@pytest.mark.parametrize("guard", ["discrepancy", None])
def test_tiles_are_blended_in_their_slopes_and_solved_once(guard):
    integrator = SlopeDLS(recipe="quick", n_iter=1, guard=guard)
    g, found, step = field(90, 70), np.empty((90, 70)), (0.8, 1.25)
    result = large.integrate(g, found, integrator=integrator, pixel_size=step, tile=20, halo=8, memory=2**17)
    gradient, a = torch.from_numpy(g)[None], GradientOperator("forward", step)
    level, slopes = torch.tensor([result.noise], dtype=torch.float64), edge_slopes(gradient)[0]
    reference = solve(slopes, pixel_size=step).height
    for rows, p in spans(90, 20, 8):
        for columns, q in spans(70, 20, 8):
            part = gradient[..., rows, columns]
            start, height = blended(integrator._exact_runs, part, level, Grid(step), guard is not None)
            slopes[..., rows, columns] += p[:, None] * q * a(height - start)
    change = dct2(solve(slopes, pixel_size=step).height - reference)
    # Waves of more than 24 pixels are those of the whole at 30 x 24 blocks.
    blocks, wide = torch.nn.functional.adaptive_avg_pool2d(gradient, (30, 24)), (0.8 * 70 / 24, 1.25 * 3)
    unit = (wide[0] * wide[1]) ** 0.5
    grid = Grid((wide[0] / unit, wide[1] / unit))
    start, height = blended(integrator._exact_runs, blocks, level * (720 / 6300) ** 0.5, grid, guard is not None)
    low, k, m = dct2(height - start) * unit * (6300 / 720) ** 0.5, torch.arange(30) / 180, torch.arange(24) / 140
    long = k[:, None].square() + m.square() < (1 / 24) ** 2
    long[0, 0] = False
    change[..., :30, :24] = torch.where(long, low, change[..., :30, :24])
    smooth = reference + idct2(change)
    expected = shrink_slow_waves(smooth, reference, level, step)
    expected = expected if guard is None else cautious(expected, reference, smooth, level, step)
    np.testing.assert_allclose(found, expected[0, 0].numpy(), rtol=0, atol=1e-9)
    assert result.tiles == (4, 3)
    whole_level = float(noise_level(gradient, pixel_size=step))
    assert result.noise == pytest.approx(whole_level, rel=0.1)


@pytest.mark.parametrize("n, tile, halo", [(256, 96, 32), (1000, 64, 16), (101, 10, 3), (65, 1, 0), (7, 100, 5)])
def test_windows_cover_the_surface_and_their_weights_add_up(n, tile, halo):
    found, total = spans(n, tile, halo), torch.zeros(n, dtype=torch.float64)
    for pixels, weight in found:
        assert pixels.stop - pixels.start == min(n, tile + 2 * halo)
        assert float(weight.min()) >= 0
        total[pixels] += weight
        if pixels.start:  # the rim counts for nothing
            assert not weight[: halo // 2].any()
    torch.testing.assert_close(total, torch.ones_like(total), rtol=0, atol=1e-12)
    assert all(b.pixels.start - a.pixels.start <= tile + 1 for a, b in pairwise(found))


@pytest.mark.parametrize(
    "integrator, error, match",
    [
        (HarkerOLeary(), TypeError, "LeastSquares, SlopeDLS or DLS"),
        (DLS(), ValueError, "learner, select of DLS"),
        (DLS(learner=BLOCK), ValueError, "select of DLS"),
        (DLS(learner=BLOCK, mu=0.1, height_step="proximal"), ValueError, "height_step of DLS"),
        (DLS(learner=BLOCK, mu=0.1, data_term=Huber()), ValueError, "data_term of DLS"),
        (DLS(learn="fixed", mu=0.1, boundary="periodic"), ValueError, "boundary of DLS"),
        (SlopeDLS(recipe="plain"), ValueError, "not done in tiles"),
        (SlopeDLS(robust=True), ValueError, "robust=True"),
        (SlopeDLS(guard="sure"), ValueError, "guard='sure'"),
        (SlopeDLS(sigma=torch.ones(1, 1, 8, 8)), ValueError, "not done in tiles"),
        (LeastSquares(boundary="dirichlet"), ValueError, "boundary='dirichlet'"),
    ],
)
def test_what_is_not_done_in_tiles(integrator, error, match):
    with pytest.raises(error, match=match):
        large.integrate(np.zeros((2, 8, 8)), np.zeros((8, 8)), integrator=integrator)


@pytest.mark.parametrize("tile, step", [(7, (1.0, 1.0)), (33, (2.0, 0.5)), (200, (1.0, 1.0))])
def test_masked_least_squares_equals_that_in_memory(tile, step):
    g, mask, found = field(80, 66), disk_ring_and_specks(80, 66), np.empty((80, 66))
    holed = np.where(mask, g, np.nan)
    exact = LeastSquares(tol=1e-12, pixel_size=step)
    result = large.integrate(holed, found, mask=mask, integrator=exact, tile=tile)
    expected = exact(torch.from_numpy(holed), torch.from_numpy(mask)[None])[0].numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert result.converged
    assert 5 < result.iterations < 100


def test_masked_in_single_precision_and_from_files(tmp_path):
    g, mask = field(90, 70, np.float32), disk_ring_and_specks(90, 70)
    np.save(tmp_path / "g.npy", g)
    np.save(tmp_path / "m.npy", mask.astype(np.uint8) * 255)
    large.integrate(tmp_path / "g.npy", tmp_path / "z.npy", mask=tmp_path / "m.npy", tile=20)
    expected = LeastSquares(tol=1e-10)(torch.from_numpy(g).double(), torch.from_numpy(mask)[None])[0].numpy()
    assert np.abs(np.load(tmp_path / "z.npy") - expected).max() < 1e-4 * np.ptp(expected)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["g.npy", "m.npy", "z.npy"]


def test_masked_normals_read_nothing_outside():
    g, mask = field(40, 50), disk_ring_and_specks(40, 50)
    normals = np.where(mask, gradient_to_normals(torch.from_numpy(g)).numpy(), np.nan)
    found, again = np.empty((40, 50)), np.empty((40, 50))
    large.integrate(normals, found, mask=mask, tile=16)
    large.integrate(g, again, mask=mask, tile=16)
    np.testing.assert_allclose(found, again, rtol=0, atol=1e-9)
    assert not found[~mask].any()


@pytest.mark.parametrize("tile", [1, 3, 50])
def test_components_over_bands(tile, tmp_path):
    mask = np.random.default_rng(1).random((23, 31)) < 0.6
    passes = Passes(Field(np.zeros((2, 23, 31)), None, mask), (1.0, 1.0), tile, tmp_path, lambda text: None)
    parts = Parts(passes, lambda rows: Edges(passes).trusts(rows) > 0)
    labels, count = label(mask)
    alone = np.flatnonzero(np.bincount(labels.ravel()) == 1)
    mask &= ~np.isin(labels, alone)  # a pixel without a neighbour has nothing to say
    labels, count = label(mask)
    found = np.concatenate([parts.of(rows) for rows in passes.bands()])
    assert len(parts.size) == count + 1
    assert (found[~mask] == count).all()
    pairs = np.unique(np.stack([labels[mask], found[mask]]), axis=1)
    assert pairs.shape[1] == count  # one number each
    for own, theirs in pairs.T:
        assert parts.size[theirs] == (labels == own).sum()


def test_what_a_mask_may_not_be():
    g, z = np.zeros((2, 8, 8)), np.zeros((8, 8))
    with pytest.raises(ValueError, match=r"mask \(8, 9\)"):
        large.integrate(g, z, mask=np.ones((8, 9)))
    with pytest.raises(ValueError, match="False everywhere"):
        large.integrate(g, z, mask=np.zeros((8, 8)))
    with pytest.raises(ValueError, match="least squares alone"):
        large.integrate(g, z, mask=np.ones((8, 8)), integrator=SlopeDLS())
    with pytest.raises(ValueError, match="not finite in rows 0 to"):
        large.integrate(g * np.nan, z, mask=np.ones((8, 8)))
    large.integrate(g, z, mask=np.ones((8, 8)))
    assert not z.any()
    with pytest.warns(ConvergenceWarning, match="after 1 iterations"):
        large.integrate(field(30, 30), np.empty((30, 30)), mask=np.tri(30), integrator=LeastSquares(max_iter=1))


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="room on a disk cannot be asked for here")
def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    """A page of a file in memory that finds no room would end the process; a limit stands for the disk here."""
    import resource
    import signal

    field = np.zeros((2, 100, 100))
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        with pytest.raises(OSError, match=r"\.npy"):
            large.integrate(field, np.empty((100, 100)), tile=50, scratch=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())
