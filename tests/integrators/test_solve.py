"""`solve` on every integrator, and what a new one needs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tests.helpers import uniform_field
from tests.helpers.methods import bumps, everything, method
from torchdls import DLS, INTEGRATORS, Integrator, LeastSquares, Unroll, _registry
from torchdls.integrators import Fields
from torchdls.integrators.robust import Robust
from torchdls.operators import slope_divergence
from torchdls.solvers import solve_direct

pytestmark = pytest.mark.device


@pytest.mark.parametrize("name", INTEGRATORS)
def test_tells_the_height_of_the_call_and_how_it_went(name: str) -> None:
    integrator = method(name).build(name, pixel_size=(0.5, 2.0))
    g = bumps(2)
    result = integrator.solve(g, **everything(integrator, g))
    assert torch.equal(result.height, integrator(g, **everything(integrator, g)))
    assert result.iterations.shape == result.converged.shape == (2,)
    assert result.iterations.dtype == torch.int64
    assert result.converged.dtype == torch.bool
    assert bool((result.iterations >= 0).all())
    assert integrator.solve(g[0]).height.shape == (1, 1, 16, 14)


def test_says_when_it_did_not_converge() -> None:
    g = bumps(1)
    weight = 0.1 + uniform_field(1, 1, 16, 14)
    with pytest.warns(UserWarning, match="stopped after 1"):
        result = LeastSquares(max_iter=1, tol=1e-12).solve(g, weight=weight)
    assert result.iterations.tolist() == [1]
    assert result.converged.tolist() == [False]
    better = LeastSquares(tol=1e-12).solve(g, weight=weight)
    assert better.converged.all()
    assert int(better.iterations) > 1


@pytest.mark.parametrize("checkpoint", [False, True])
def test_dls_counts_the_iterations_of_each_surface(checkpoint: bool) -> None:
    g = torch.cat([bumps(1, noise=0.3), 0.0 * bumps(1)])  # the second one has settled at once
    g = g.requires_grad_(checkpoint)
    dls = DLS(patch_size=4, n_iter=6, tol=1e-2, mu=0.3, derivative=Unroll(checkpoint))
    result = dls.solve(g)
    alone = [dls.solve(one[None]) for one in g]
    assert result.iterations.tolist() == [int(one.iterations) for one in alone]
    assert int(result.iterations[1]) < int(result.iterations[0]) <= 6


class Direct(Integrator):
    """The least-squares surface of a full rectangle: what a new integrator takes."""

    accepts = frozenset()

    def _integrate(self, fields: Fields) -> Tensor:
        return solve_direct(slope_divergence(fields.gradient, fields.steps), None, fields.steps)


def test_a_new_integrator_is_one_class_and_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(INTEGRATORS._classes, "direct", f"{__name__}.Direct")
    assert "direct" in _registry.INTEGRATORS
    integrator = INTEGRATORS["direct"](pixel_size=(0.5, 2.0))
    plane = torch.tensor([0.3, -0.7], dtype=torch.float64).view(1, 2, 1, 1).expand(2, 2, 7, 9)
    x, y = 0.5 * torch.arange(9, dtype=torch.float64), 2 * torch.arange(7, dtype=torch.float64)
    expected = 0.3 * x - 0.7 * y[:, None]
    torch.testing.assert_close(integrator(plane)[0, 0], expected - expected.mean())
    torch.testing.assert_close(integrator(bumps(2)), LeastSquares(pixel_size=(0.5, 2.0))(bumps(2)))
    assert integrator.solve(plane).converged.all()
    with pytest.raises(ValueError, match="Direct: takes no mask"):
        integrator(plane, mask=torch.ones(2, 1, 7, 9, dtype=torch.bool))


def test_what_is_missing_is_said_when_it_is_made() -> None:
    class Nothing(Integrator):
        pass

    class NoTerm(Robust):
        pass

    with pytest.raises(TypeError, match=r"Nothing.*integrate"):
        Nothing()  # type: ignore[abstract]
    with pytest.raises(TypeError, match=r"NoTerm.*data_term"):
        NoTerm(n_iter=1, tol=0)  # type: ignore[abstract]


@pytest.mark.parametrize("name", INTEGRATORS)
def test_shows_what_a_user_calls_alone(name: str) -> None:
    """Beside what every module has: the call, `solve`, options, and those of the method itself."""
    integrator = method(name).build(name)
    own = {n for n in dir(integrator) if not n.startswith("_")} - set(dir(nn.Module()))
    options = set(INTEGRATORS.parameters(name)) | {"accepts", "from_edges", "options", "solve"}
    more = {
        "dls": {"patches"},
        "slope_dls": {"fast"},
        "weighted_least_squares": {"boundary"},
        "mumford_shah": {"indicator"},
        "b_spline": {"evaluate", "upsample"},
        "partial_integrability": {"released"},
    }
    assert own - options == more.get(name, set())


@pytest.mark.parametrize("name", INTEGRATORS)
def test_the_data_term_is_what_it_says(name: str) -> None:
    """One quadratic, or one that follows the height; methods without one say so."""
    integrator, g = method(name).build(name), bumps(2)
    fields = integrator._check_fields(g)
    if integrator._steady is None:
        with pytest.raises(TypeError, match="not built on the solve"):
            integrator._data_term(fields)
        with pytest.raises(ValueError, match="not built on the weighted solve"):
            DLS(data_term=integrator)
        return
    data = integrator._data_term(fields)
    assert data.steady == integrator._steady
    one, other = (data.majoriser(height) for height in (g[:, :1], 3 * g[:, 1:]))
    same = torch.equal(one[0], other[0]) and (one[1] is None or torch.equal(one[1], other[1]))
    assert same == data.steady


def test_a_class_with_the_old_name_of_the_hook_is_refused() -> None:
    class Old(Integrator):
        def integrate(self, fields: Fields) -> Tensor:
            return fields.gradient[:, :1]

    with pytest.raises(TypeError, match="_integrate"):
        Old()  # type: ignore[abstract]
