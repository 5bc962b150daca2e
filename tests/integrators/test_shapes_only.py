"""Tensors without values, graphs for every batch size, and views that PyTorch has not yet written down."""

from typing import Any

import pytest
import torch
from torch._subclasses import FakeTensorMode
from torch.func import functional_call

import torchdls
from tests.helpers import MASKS, random_field, uniform_field
from tests.helpers.methods import bumps, everything, method
from torchdls import DLS, INTEGRATORS, LeastSquares, SlopeDLS, Unroll
from torchdls.operators import dct2
from torchdls.selection import _bands, _most_bands


def fixed(name, **more):
    """The method with a fixed number of steps."""
    known = INTEGRATORS.parameters(name)
    steps = {k: v for k, v in {"n_iter": 2, "tol": 0.0}.items() if k in known and "n_iter" in known}
    return method(name).build(name, **{**steps, **more})


# Not Piecewise, whose steps follow values.
FORMS: list[tuple[str, dict[str, Any]]] = [(name, {}) for name in INTEGRATORS if name != "piecewise"]
FORMS += [
    ("dls", {"learner": "fixed"}),
    ("dls", {"select": True, "mu": "auto"}),
    ("dls", {"derivative": Unroll(checkpoint=True)}),
]
FORMS += [("dls", {"height_step": "proximal"}), ("dls", {"learner": "dino_kat"})]
FORMS += [("dls", {"learn": "shared"}), ("m_estimator", {"tol": 1e-3})]
FORMS += [("slope_dls", {"recipe": "quick"}), ("slope_dls", {"recipe": "plain"}), ("slope_dls", {"guard": "sure"})]
FORMS += [("least_squares", {"boundary": "dirichlet"}), ("frankot_chellappa", {"extension": "mirrored"})]
MORE = [("slope_dls", {"robust": True}), ("dls", {"learner": "k_svd"})]
BATCH = (2, 1, 16, 14)


def arguments(integrator, g, all_of_them):
    given = everything(integrator, g) if all_of_them else {}
    return {} if getattr(integrator, "select", False) else given


@pytest.mark.parametrize(
    "all_of_them", [pytest.param(False, id="gradient"), pytest.param(True, id="everything", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name, options", FORMS)
def test_meta_tensors_pass_through(name, options, all_of_them):
    """Shapes, dtypes and those of the derivatives, for any method, mask, weight and anchor."""
    few = {"max_iter": 2} if name == "horn_brooks" else {}
    integrator, g = fixed(name, **options, **few), bumps(2).float()
    optional = {k: v.to("meta") for k, v in arguments(integrator, g, all_of_them).items()}
    leaf = g.to("meta").requires_grad_()
    for run in (integrator, lambda g, **kw: integrator.solve(g, **kw).height):
        z = run(leaf, **optional)
        assert (z.device.type, z.shape, z.dtype) == ("meta", BATCH, torch.float32)
        z.sum().backward()
        assert leaf.grad.shape == g.shape
        assert leaf.grad.is_meta


@pytest.mark.slow
@pytest.mark.parametrize("name, options", FORMS)
def test_fake_tensors_pass_through(name, options):
    if name == "horn_brooks":
        pytest.skip("its sweeps are as many as values say, up to 10,000")
    integrator, g = fixed(name, **options), bumps(2).float()
    optional = arguments(integrator, g, True)
    state = integrator.state_dict()
    with FakeTensorMode() as mode:
        state = {k: mode.from_tensor(v) for k, v in state.items()}
        leaf = mode.from_tensor(g).requires_grad_()
        z = functional_call(integrator, state, (leaf,), {k: mode.from_tensor(v) for k, v in optional.items()})
        z.sum().backward()
        assert z.shape == BATCH
        assert leaf.grad.shape == g.shape
        assert DLS(4, n_atoms=9).dictionary.shape == (16, 9)  # made in there
    real = integrator(g, **optional)  # no table without values was kept
    assert real.isfinite().all()
    assert torch.equal(real, fixed(name, **options)(g, **optional))


def test_atoms_of_sixteen_samples_are_made_without_values():
    with FakeTensorMode():
        assert SlopeDLS()(torch.empty(2, 2, 16, 18)).shape == (2, 1, 16, 18)


def test_no_surface_comes_from_a_graph_that_cannot_be_made():
    """Conjugate gradients look at values: a graph of them is refused, rather than made of the shapes alone."""
    g, mask = bumps(2).float(), MASKS["disk"](16, 14).expand(2, -1, -1, -1)
    with pytest.raises(Exception, match="data-dependent"):
        torch.export.export(LeastSquares(), (g, mask), strict=False)
    with pytest.raises(Exception, match=r"(?i)data.?dependent"):
        torch.fx.experimental.proxy_tensor.make_fx(LeastSquares(), tracing_mode="fake")(g, mask)


@pytest.mark.parametrize(
    "integrator, size",
    [
        (LeastSquares(), (40, 36)),
        (LeastSquares(pixel_size=(0.5, 2.0)), (97, 80)),
        (torchdls.FrankotChellappa(), (20, 17)),
        (torchdls.HarkerOLeary(), (20, 17)),
        (torchdls.Huber(n_iter=3, tol=0.0), (20, 17)),
        pytest.param(SlopeDLS.fast(), (40, 36), marks=pytest.mark.slow),
        (SlopeDLS.fast(patch_sizes=(8,), n_iter=1), (12, 13)),
    ],
    ids=["least_squares", "large", "frankot_chellappa", "harker_oleary", "huber", "fast", "one_step"],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_export_for_every_batch_size(integrator, size):
    g = random_field(3, 2, *size, dtype=torch.float32)
    batch = torch.export.Dim("batch", min=1, max=4096)
    program = torch.export.export(integrator, (g,), dynamic_shapes=({0: batch},), strict=False).module()
    for n in (1, 2, 7):
        other = random_field(n, 2, *size, seed=n, dtype=torch.float32)
        torch.testing.assert_close(program(other), integrator(other), rtol=1e-4, atol=1e-4)


def test_the_bands_are_counted_from_the_size():
    """No mode has a band beyond the count, and the count is not far above the largest."""
    for h, w in [(1, 1), (1, 9), (7, 1), (2, 2), (5, 300), (16, 14), (65, 64), (257, 129)]:
        most = int(_bands(h, w, "neumann", like=torch.empty(0)).max()) + 1
        assert most <= _most_bands(h, w) <= max(most, 1) + 24


# Views


def views(x):
    """The same values, as views that are negative, or conjugate and then negative."""
    return [torch._neg_view(-x), torch.complex(x, -x).conj().imag]


@pytest.mark.parametrize("name, options", [*FORMS, *MORE])
def test_negative_and_conjugate_views(name, options):
    integrator, g = fixed(name, **options), bumps(1).float()
    optional = arguments(integrator, g, True)
    expected = integrator(g, **optional)
    for i, view in enumerate(views(g)):
        assert view.is_neg()
        assert torch.equal(view, g)
        given = {k: views(v)[i] if v.is_floating_point() else v for k, v in optional.items()}
        assert torch.equal(integrator(view, **given), expected)
        leaf = view.detach().requires_grad_()
        assert torch.equal(integrator(leaf, **given).detach(), integrator(g.clone().requires_grad_(), **optional))


def test_negative_views_elsewhere():
    g, z = bumps(1).float(), random_field(1, 1, 16, 14, dtype=torch.float32)
    lights, images = torchdls.ring_of_lights(8, 45), 0.2 + uniform_field(1, 8, 6, 5, dtype=torch.float32)
    n = torchdls.gradient_to_normals(g)
    calls: list[tuple[Any, torch.Tensor]] = [
        (torchdls.noise_level, g), (dct2, z), (lambda x: torchdls.normals_to_gradient(x).gradient, n),
        (torchdls.gradient_to_normals, g), (lambda x: torchdls.select(torchdls.HarkerOLeary(), x, 1).height, g),
        (lambda x: torchdls.render(n, x, highlight=0.5), lights), (lambda x: torchdls.cast_shadows(z, x), lights),
        (lambda x: torchdls.cast_shadows(x, lights), z), (lambda x: torchdls.woodham(images, x).normals, lights),
        (lambda x: torchdls.woodham(x, lights).confidence, images), (lambda x: torchdls.rmse(x, z.square()), z),
        (lambda x: torchdls.sparse_normals(x, lights, n_iter=3).normals, images),
        (lambda x: torchdls.low_rank_normals(x, lights).normals, images),
        (lambda x: torchdls.orthogonal_matching_pursuit(x, torch.eye(16)[None], 2), z[0]),
        (lambda x: torchdls.soup_dil_sweep(x, torch.eye(16)[None], torch.zeros(1, 16, 14), 0.5)[0], z[0]),
    ]  # fmt: skip
    for f, x in calls:
        for view in views(x):
            torch.testing.assert_close(f(view), f(x))
