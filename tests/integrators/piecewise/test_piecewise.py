"""Piecewise against closed forms: surfaces that jump, pieces that have no tie, and fields that do not jump."""

import math

import pytest
import torch
from torch import Tensor

from tests.helpers import random_field
from torchdls import (
    DLS,
    SURFACES,
    Bilateral,
    LeastSquares,
    Piecewise,
    SlopeDLS,
    edge_slopes,
    gradient_to_normals,
    normals_to_gradient,
    rmse,
    solve,
)
from torchdls.integrators.fields import Fields
from torchdls.integrators.piecewise.integrator import _HELD, _Search
from torchdls.integrators.piecewise.measured import GRAZING, believed, ends, filled, follows_tilt, measure
from torchdls.integrators.piecewise.pieces import pieces_of, tied_pieces
from torchdls.integrators.piecewise.prior import NAMES, continued, features, fitted, log_odds
from torchdls.integrators.piecewise.search import (
    Costs,
    Problem,
    _loose,
    _safe,
    energy,
    out_of_order,
    robust_weights,
    search,
)


def hinged(n: int = 32) -> tuple[Tensor, Tensor]:
    """A ramp that rises from a plane along one side and jumps at the other three: slopes and height."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    block = (x > 0.25 * n) & (y > 0.25 * n) & (y < 0.75 * n)
    slopes = torch.stack([torch.where(block, 0.5, 0.0), torch.zeros_like(x)])[None]
    return slopes, torch.where(block, (x - 0.25 * n) / 2, 0.0)[None, None]


def ball_before_a_wall(n: int = 40, above: float = 30.0) -> tuple[Tensor, Tensor, Tensor]:
    """A half ball that floats before a plane: slopes, mask and height; its rim tells no distance."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) - (n - 1) / 2,) * 2, indexing="ij")
    r = 0.3 * n
    inside = x**2 + y**2 < r**2
    z = torch.where(inside, (r**2 - x**2 - y**2).clamp(min=1e-12).sqrt(), 1.0)
    normals = torch.where(inside, torch.stack([x, -y, z]) / r, torch.tensor([0, 0, 1.0]).double().view(3, 1, 1))
    field = normals_to_gradient(normals[None])
    return (
        field.gradient,
        field.mask,
        torch.where(inside, above + z, 0.1 * x)[None, None] - torch.where(inside, 0, 0.1 * x),
    )


def problem_of(p: Tensor, weight: Tensor | None = None) -> Problem:
    fields = Fields(p, None, weight, None, None, (1.0, 1.0))
    noise = p.new_zeros(len(p))
    return Problem.of(measure(p, fields, noise), noise, fields)


def test_a_hinged_ramp_is_found_where_least_squares_bends_it():
    slopes, true = hinged()
    error = float(rmse(Piecewise()(slopes), true))
    assert error < 0.2
    for other in (LeastSquares(), Bilateral()):
        assert error < 0.1 * float(rmse(other(slopes), true))


def test_jumps_are_where_the_surface_jumps():
    slopes, true = hinged()
    result = Piecewise().solve(slopes)
    down = (true[..., 1:, :] - true[..., :-1, :])[0, 0].abs()
    assert (result.jump[0, 1, :-1][down > 2] > 0.5).all()
    assert (result.jump[0, 1, :-1][down == 0] < 0.5).all()
    assert not result.smooth.any()


def test_log_depth_with_a_focal_length_is_the_height_turned_away():
    slopes, _ = hinged()
    f = 500.0
    away = Piecewise(focal_length=f)(-slopes / f)
    torch.testing.assert_close(-f * away, Piecewise()(slopes), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("turn", [lambda x: x.flip(-1), lambda x: x.flip(-2), lambda x: x.mT])
def test_follows_flips_and_a_transpose_without_noise(turn):
    slopes, _ = hinged()
    slopes = slopes + 0.05 * torch.sin(torch.arange(32.0)).double()
    expected = turn(Piecewise(noise=0.0)(slopes))
    x, y = turn(slopes).unbind(1)
    transposed = turn(torch.zeros(1, 1, 2, 3)).shape[-1] == 2
    sign_x, sign_y = (1, 1) if transposed else (1 - 2 * (turn(torch.arange(6.0).view(2, 3))[0, 0] == 2).int(), 1)
    if not transposed and int(sign_x) == 1:
        sign_y = -1
    field = torch.stack([y, x] if transposed else [sign_x * x, sign_y * y], 1)
    torch.testing.assert_close(Piecewise(noise=0.0)(field), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["peaks", "sphere"])
@pytest.mark.parametrize("degrees", [0, 10])
def test_where_nothing_jumps_it_is_slope_dls(name, degrees):
    surface = SURFACES[name](48, dtype=torch.float64)
    slopes = surface.gradient + math.radians(degrees) * random_field(1, 2, 48, 48, seed=degrees)
    result = Piecewise().solve(slopes)
    assert result.smooth.all()
    assert torch.equal(result.height, SlopeDLS()._integrate(SlopeDLS()._check_fields(slopes)))
    assert result.pieces.unique().tolist() == [1]
    assert result.tied.all()


def test_a_batch_takes_each_surface_by_itself():
    ramp, plain = hinged()[0], SURFACES["peaks"](32, dtype=torch.float64).gradient
    both = Piecewise().solve(torch.cat([ramp, plain]))
    assert both.smooth.tolist() == [False, True]
    for i, one in enumerate((ramp, plain)):
        torch.testing.assert_close(both.height[i : i + 1], Piecewise()(one), rtol=1e-6, atol=1e-7)


def floating_plate(n: int = 40) -> tuple[Tensor, Tensor]:
    """An oblique plate far before a plane: it can meet the plane in one point, along no side."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64),) * 2, indexing="ij")
    plate = (x > 9) & (x < 30) & (y > 9) & (y < 30)
    slopes = torch.stack([0.8 * plate.double(), 0.6 * plate.double()])[None]
    return slopes, torch.where(plate, 60 + 0.8 * (x - 20) + 0.6 * (y - 20), 0.0)[None, None]


def test_a_piece_without_a_tie_is_told_and_one_anchor_brings_it_to_its_place():
    slopes, true = floating_plate()
    loose = Piecewise().solve(slopes)
    number = int(loose.pieces[0, 0, 20, 20])
    assert number > 1
    assert not loose.tied[0, number - 1]
    assert loose.tied[0, 0]
    assert float(rmse(loose.height, true)) > 5
    weight = torch.zeros_like(true)
    weight[0, 0, 20, 20] = weight[0, 0, 2, 2] = 1.0
    held = Piecewise().solve(slopes, anchor=true, anchor_weight=weight)
    assert held.tied[0, int(held.pieces[0, 0, 20, 20]) - 1]
    assert float((held.height - true).abs().mean()) < 0.1


def test_derivative_is_that_of_the_last_solve_with_weights_and_jumps_held():
    slopes, _ = hinged(24)
    slopes = slopes + 0.02 * random_field(*slopes.shape, seed=2)
    probe, direction = random_field(1, 1, 24, 24, seed=3), random_field(*slopes.shape, seed=4)
    method = Piecewise(noise=0.0, solve_tol=1e-13)
    leaf = slopes.clone().requires_grad_()
    result = method.solve(leaf)
    assert not result.smooth.any()
    (found,) = torch.autograd.grad((result.height * probe).sum(), leaf)
    w, d, *_ = _Search.apply(-slopes, -slopes, None, None, None, None, torch.zeros(1).double(), -1.0, (1.0, 1.0))

    def held(t: float) -> Tensor:
        v, _ = edge_slopes(-believed(-(slopes + t * direction)))
        live = edge_slopes(slopes, torch.ones(1, 1, 24, 24, dtype=torch.bool))[1] > 0
        k = _HELD * w.max() * live
        total = torch.where(live, w, 0) + k
        v = torch.where(live, (w * v - k * d) / torch.where(live, total, 1), 0)
        return (solve(v, total, tol=1e-13).height * probe).sum()

    numeric = (held(1e-4) - held(-1e-4)) / 2e-4
    torch.testing.assert_close((found * direction).sum(), numeric, rtol=1e-5, atol=1e-8)
    assert float((held(0.0) - (result.height.detach() * probe).sum()).abs()) < 1e-6


def test_jumps_are_out_of_order_where_the_side_that_dives_is_farther():
    """A ball before a wall has its rim nearer; pushed through it, all jumps of its rim contradict the normals."""
    gradient, mask, height = ball_before_a_wall()
    fields = Fields(-gradient, mask, None, None, None, (1.0, 1.0))
    problem = Problem.of(measure(-gradient, fields, torch.zeros(1)), torch.zeros(1).double(), fields)
    assert float(out_of_order(problem, -height)) < 0.05
    behind = torch.where(height > 20, height - 90, height)
    assert float(out_of_order(problem, -behind)) > 0.9


def test_where_jumps_are_not_believed_the_height_is_that_from_bilateral_for_this_surface_alone():
    """A plate that floats has no side at which it meets the plane, whichever way it lies; a hinged ramp has one."""
    both = torch.cat([floating_plate(32)[0], hinged(32)[0]])
    found, alone = search(problem_of(-both)), search(problem_of(-both[:1]))
    assert found.doubtful.tolist() == [True, False]
    torch.testing.assert_close(found.y[:1], _safe(problem_of(-both[:1])), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.cut[:1], alone.cut, rtol=1e-6, atol=1e-6)


def test_share_of_the_pixels_in_pieces_without_a_tie():
    pieces = torch.tensor([[[[1, 1, 2, 0]]], [[[1, 2, 2, 3]]]])
    tied = torch.tensor([[True, False, True], [False, False, True]])
    torch.testing.assert_close(_loose(pieces, tied), torch.tensor([1 / 3, 3 / 4]))


def test_energy_is_lowered_by_its_reweighted_solves():
    p = -hinged(16)[0] + 0.1 * random_field(1, 2, 16, 16, seed=1)
    problem = problem_of(p)
    cost = Costs(torch.full_like(p, 3.0), torch.full_like(p, 1.0))
    y = problem.solve(torch.ones_like(p))
    before = energy(problem, y, cost)
    for _ in range(4):
        y = problem.solve(robust_weights(problem, y, cost), y=y)
        after = energy(problem, y, cost)
        assert after <= before * (1 + 1e-9)
        before = after


def test_solve_of_the_search_is_the_dense_one():
    p = random_field(1, 2, 5, 4, seed=1)
    problem = problem_of(p)
    w = random_field(1, 2, 5, 4, seed=2).square() + 0.1
    y = problem.solve(w)
    rows, right = [], []
    for c, (di, dj) in enumerate(((0, 1), (1, 0))):
        for i in range(5 - di):
            for j in range(4 - dj):
                row = torch.zeros(5, 4).double()
                row[i + di, j + dj], row[i, j] = 1, -1
                rows.append(row.flatten() * w[0, c, i, j].sqrt())
                right.append(problem.m.v[0, c, i, j] * w[0, c, i, j].sqrt())
    dense = torch.linalg.lstsq(torch.stack(rows), torch.stack(right)[:, None], driver="gelsd").solution.view(1, 1, 5, 4)
    torch.testing.assert_close(y - y.mean(), dense - dense.mean(), rtol=1e-6, atol=1e-6)


def test_slopes_grow_no_further_at_grazing_angle():
    p = torch.tensor([[3.0, 1e6], [0.0, 0.0]]).double().view(1, 2, 1, 2)
    found = believed(p)
    torch.testing.assert_close(found[0, 0, 0], torch.tensor([3.0, 1 / GRAZING]).double(), rtol=1e-6, atol=0)


def test_samples_without_weight_are_filled_from_beside_them():
    g = random_field(1, 2, 3, 3, seed=1)
    weight = torch.ones(1, 1, 3, 3).double()
    weight[..., 1, 1] = 0
    found = filled(g, Fields(g, None, weight, None, None, (1.0, 1.0)))
    expected = (g[..., 0, 1] + g[..., 2, 1] + g[..., 1, 0] + g[..., 1, 2]) / 4
    torch.testing.assert_close(found[..., 1, 1], expected)
    assert torch.equal(found[..., 0, :], g[..., 0, :])


def test_angles_are_those_of_the_normals():
    p = random_field(1, 2, 4, 5, seed=3)
    m = measure(p, Fields(p, None, None, None, None, (1.0, 1.0)), torch.zeros(1).double())
    n = torch.cat([p, torch.ones(1, 1, 4, 5)], 1)
    n = n / n.norm(dim=1, keepdim=True)
    expected = torch.rad2deg(torch.acos((n[0, :, 1, 2] * n[0, :, 1, 3]).sum()))
    torch.testing.assert_close(m.angle[0, 0, 1, 2], expected)
    assert torch.equal(ends(p)[0, 1, 1, 2, 2], p[0, 1, 3, 2])


def test_prior_knows_which_side_is_nearer():
    """A ball before a wall: at its left the ball's side is on the right of the edge, and it is nearer."""
    gradient, mask, _ = ball_before_a_wall()
    p = -gradient
    m = measure(p, Fields(p, mask, None, None, None, (1.0, 1.0)), torch.zeros(1).double())
    odds = log_odds(features(m), torch.zeros(1).double())
    row = 20
    columns = ((m.angle[0, 0, row] > 40) & m.live[0, 0, row]).nonzero().flatten()
    left, right = int(columns[0]), int(columns[-1])
    assert odds[0, 1, 0, row, left] > odds[0, 0, 0, row, left] + 1  # j is nearer
    assert odds[0, 0, 0, row, right] > odds[0, 1, 0, row, right] + 1
    assert odds[0, :, 0, 2, 2].max() < -5  # on the plane nothing is cut
    assert len(NAMES) == fitted().alone.shape[1] == fitted().coupled.shape[1] - 1


def test_contours_go_on_at_both_ends():
    cut = torch.zeros(1, 2, 6, 6, dtype=torch.float64)
    cut[0, 0, 1:5, 2] = 1  # a straight contour between columns 2 and 3
    live = torch.ones_like(cut, dtype=torch.bool)
    live[0, 0, :, -1] = live[0, 1, -1] = False
    around = continued(cut, live)
    assert around[0, 0, 2, 2] == 2
    assert around[0, 0, 1, 2] == 1  # it ends here
    assert around[0, 0, 3, 4] == 0


def test_pieces_by_size_and_their_ties():
    live = torch.ones(1, 2, 8, 8, dtype=torch.bool)
    live[0, 0, :, -1] = live[0, 1, -1] = False
    cut = torch.zeros_like(live)
    cut[0, 0, :, 2] = True  # three columns and five
    cut[0, 0, 4, 2] = False  # a gap of one edge is an accident
    inside = torch.ones(1, 1, 8, 8, dtype=torch.bool)
    pieces = pieces_of(cut, torch.zeros_like(cut), live, inside)
    assert (pieces[..., :3] == 2).all()
    assert (pieces[..., 3:] == 1).all()
    cut[0, 0, 2:6, 2] = False  # a gap of four edges is a tie
    assert (pieces_of(cut, torch.zeros_like(cut), live, inside) == 1).all()
    likely = torch.zeros_like(cut)
    likely[0, 0, :, 2] = True
    assert torch.equal(pieces_of(cut, likely, live, inside), pieces)  # unless it may be cut
    nowhere = torch.zeros_like(inside)
    assert tied_pieces(pieces, live, nowhere).tolist() == [[True, False]]
    anchored = nowhere.clone()
    anchored[..., 0, 0] = True
    assert tied_pieces(pieces, live, anchored).tolist() == [[False, True]]


def test_what_noisy_normals_say_of_a_steep_plane_has_no_bias():
    """Mean slopes of noisy normals are too steep; what is linear in the noise errs by what noise leaves of a mean."""
    size, steep, sigma = 96, 2.0, 0.1
    coded = torch.zeros(1, 2, size, size, dtype=torch.float64)
    coded[:, 0] = steep
    n = torch.tensor([steep, 0.0, 1.0]).double().view(1, 3, 1, 1) / 5**0.5
    noise = sigma * random_field(1, 3, size, size, seed=3)
    n = torch.nn.functional.normalize(n + noise - (noise * n).sum(1, keepdim=True) * n, dim=1)
    raw, method = n[:, :2] / n[:, 2:], Piecewise()
    fields = method._check_fields(raw)
    live = torch.zeros_like(coded, dtype=torch.bool)
    live[:, 0, :, :-1] = True
    v = method._told(fields, coded, raw, torch.where(live, coded, 0), torch.tensor([sigma]).double())
    off, plain = (float((f[live] - steep).mean()) for f in (v, edge_slopes(raw)[0]))
    spread = sigma * 5 / size  # of the mean of so many samples: 5 = 1 + steep^2
    assert abs(off) < 3 * spread
    assert plain > 6 * spread


def test_noise_of_normals_is_told_from_that_of_slopes_and_heeded_where_nothing_jumps():
    surface = SURFACES["vase"](48, dtype=torch.float64)
    slopes = surface.gradient + 0.3 * random_field(1, 2, 48, 48, seed=1)
    n = gradient_to_normals(surface.gradient) + 0.1 * random_field(1, 3, 48, 48, seed=1)
    tilted = normals_to_gradient(n)
    inside = torch.ones_like(tilted.mask)
    assert not follows_tilt(slopes, inside)
    assert follows_tilt(tilted.gradient, tilted.mask)
    result = Piecewise().solve(tilted.gradient, tilted.mask)
    assert result.smooth.all()
    smooth = SlopeDLS()(tilted.gradient, tilted.mask)
    errors = [float(rmse(z, surface.height, tilted.mask)) for z in (result.height, smooth)]
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.parametrize("options", [{"focal_length": 0.0}, {"noise": -1.0}, {"solve_tol": 0.0}])
def test_bad_options_are_named(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        Piecewise(**options)


def test_as_data_term_of_dls_it_keeps_the_jumps():
    slopes, height = hinged(40)
    noisy = slopes + 0.03 * random_field(1, 2, 40, 40, seed=3)
    alone = Piecewise()
    both = DLS(data_term=alone, mu=0.06, n_iter=10)
    assert Piecewise._steady
    assert alone._data_term(alone._check_fields(noisy)).steady
    error, flat = (float(rmse(method(noisy), height)) for method in (both, DLS(mu=0.06, n_iter=10)))
    assert error < 0.1 * flat
