"""Every function of tensors gives inside `torch.autocast` what it gives outside, for half-precision tensors too."""

import inspect
from typing import Any

import pytest
import torch

import torchdls
from tests.helpers import random_field, uniform_field
from torchdls import GradientOperator, Patches, Surface, orthogonal_matching_pursuit, ring_of_lights, soup_dil_sweep
from torchdls._precision import full_precision
from torchdls.integrators import dls_objective
from torchdls.operators import dst2

F32 = torch.float32
g = random_field(1, 2, 16, 14, dtype=F32)
z = random_field(1, 1, 16, 14, seed=1, dtype=F32)
n = torchdls.gradient_to_normals(g)
lights = ring_of_lights(8, 45)
images = 0.2 + uniform_field(1, 8, 6, 5, seed=2, dtype=F32)
camera = torch.tensor([[20.0, 0, 7], [0, 20.0, 8], [0, 0, 1]])
P, D = (
    random_field(1, 9, 20, seed=3, dtype=F32),
    torch.nn.functional.normalize(random_field(1, 9, 12, dtype=F32), dim=1),
)
B = torch.zeros(1, 12, 20)
covariance = torch.tensor([1.0, 0.1, 0.0, 1.0, 0.2, 1.0]).view(1, 6, 1, 1).expand(1, 6, 16, 14).contiguous()
corners = torch.tensor([[0.0, 0, 1], [1, 0, 1], [1, 1, 2], [0, 1, 1]])
faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
big = random_field(1, 1, 70, 80, seed=4, dtype=F32)
noisy = lambda g: torchdls.add_noise(g, 10, torch.Generator().manual_seed(0))  # noqa: E731

# name -> function of tensors, and the tensors
CALLS: dict[str, tuple[Any, ...]] = {
    "add_noise": (noisy, g),
    "bivariate_normals": (lambda i, k: torchdls.bivariate_normals(i, k, n_iter=5).normals, images, lights),
    "cast_shadows": (torchdls.cast_shadows, z, lights),
    "convert_gradient": (lambda g: torchdls.convert_gradient(g, "depth"), g),
    "convert_normals": (lambda n: torchdls.convert_normals(n, "directx"), n),
    "dct2": (torchdls.dct2, z),
    "dct2 by FFT": (torchdls.dct2, big),
    "denoise_normals": (lambda n: torchdls.denoise_normals(n).normals, n),
    "denoise_height": (lambda z: torchdls.denoise_height(z, 0.5, patch_size=4, n_atoms=20, n_passes=1), z),
    "depth_to_points": (torchdls.depth_to_points, z.exp(), camera),
    "dlnv_normals": (lambda i, k: torchdls.dlnv_normals(i, k, patch_size=3, n_iter=1).normals, images, lights),
    "dlpi_normals": (lambda i, k: torchdls.dlpi_normals(i, k, patch_size=3, n_iter=1).normals, images, lights),
    "dls_objective": (lambda z, g, d, b: dls_objective(z, g, d, b, 0.5, 0.1, patches=Patches(3, 3)), z[..., :15, :12],
                      g[..., :15, :12], D, B),
    "edge_slopes": (lambda g: torchdls.edge_slopes(g)[0], g),
    "fit_coarse": (lambda a, b: torchdls.fit_coarse(a, b).anchor, z, z.square() + 1),
    "fit_mesh": (lambda v: torchdls.fit_mesh(v, faces, v[:2], n_iter=2).vertices, corners),
    "gradient_to_normals": (torchdls.gradient_to_normals, g),
    "GradientToNormals": (torchdls.GradientToNormals(), g),
    "GradientOperator": (GradientOperator(((((0.1, 0.5, 0.2),) * 3), (((0.1, 0.5, 0.2),) * 3))), z),
    "GradientOperator.adjoint": (GradientOperator(((((0.1, 0.5, 0.2),) * 3), (((0.1, 0.5, 0.2),) * 3))).adjoint, g),
    "height_to_points": (torchdls.height_to_points, z),
    "idct2": (torchdls.idct2, z),
    "idct2 by FFT": (torchdls.idct2, big),
    "integrate_scattered": (torchdls.integrate_scattered, g[0, 0, :, :2], g[0, 1, :, :2], z[0, 0, :, :2]),
    "lights_from_ball": (lambda i: torchdls.lights_from_ball(i, torch.ones(6, 5, dtype=torch.bool)), images[0]),
    "log_depth_to_depth": (torchdls.log_depth_to_depth, z),
    "low_rank_normals": (lambda i, k: torchdls.low_rank_normals(i, k).normals, images, lights),
    "mean_absolute_depth_error": (torchdls.mean_absolute_depth_error, z.exp(), z.exp() + 0.1),
    "mean_angular_error": (torchdls.mean_angular_error, z, g),
    "noise_level": (torchdls.noise_level, g),
    "noise_sigma": (lambda g: torchdls.noise_sigma(g, 10), g),
    "normal_noise": (torchdls.normal_noise, n),
    "normals_to_gradient": (lambda n, k: torchdls.normals_to_gradient(n, camera=k).gradient, n, camera),
    "NormalsToGradient": (torchdls.NormalsToGradient(camera=camera), n),
    "orthogonal_matching_pursuit": (lambda p, d: orthogonal_matching_pursuit(p, d, 3), P, D),
    "place_pieces": (lambda z, o: torchdls.place_pieces(z, torch.ones_like(z).long(), o), z, z[:, 0, :1, 0]),
    "Patches": (Patches(4, 2).extract, z),
    "Patches.adjoint": (lambda x: Patches(3, 3).adjoint(x, (12, 15)), P),
    "reconstruct": (lambda n: torchdls.reconstruct(n, method="least_squares").height, n),
    "refine": (lambda z, i, k: torchdls.refine(z, i, k, n_iter=2).height, z[..., :6, :5], images, lights),
    "render": (torchdls.render, n, lights),
    "rmse": (torchdls.rmse, z, z.square()),
    "select": (lambda g: torchdls.select(lambda x: torchdls.HarkerOLeary()(x), g, 1).height, g),
    "shrink_slow_waves": (lambda a, b: torchdls.shrink_slow_waves(a, b, 0.1 * torch.ones(1)), z, z.square()),
    "solve": (lambda g: torchdls.solve(g, g.abs()).height, g),
    "slope_noise": (lambda n, c: torchdls.slope_noise(n, c).covariance, n, covariance),
    "soup_dil_sweep": (lambda p, d: soup_dil_sweep(p, d, B, 0.1)[1], P, D),
    "sparse_normals": (lambda i, k: torchdls.sparse_normals(i, k, n_iter=5).normals, images, lights),
    "ssim": (lambda a, b: torchdls.ssim(a, b, 4.0), z, z.square()),
    "woodham": (lambda i, k: torchdls.woodham(i, k).normals, images, lights),
    "dst2": (dst2, z),
    "KSVD": (lambda p, d: torchdls.KSVD(2)(p, d, B, 0.1)[2], P, D),
    "DinoKat": (lambda p, d: torchdls.DinoKat()(p, d, B, 0.1)[2], P, D),
    "FixedDictionary": (lambda p, d: torchdls.FixedDictionary()(p, d, B, 0.1)[2], P, D),
    "SoupDIL": (lambda p, d: torchdls.SoupDIL()(p, d, B, 0.1)[2], P, D),
    "Focuss": (lambda p, d: torchdls.Focuss()(p, d, B, 0.1)[2], P, D),
    "BSpline.upsample": (lambda g: torchdls.BSpline().upsample(g, 2), g),
    "Unitary": (lambda p, d: torchdls.Unitary()(p, d, B[:, :9], 0.1)[2], P, D[..., :9]),
}  # fmt: skip
# What takes no tensor, gives no tensor, reads or draws a file, or is tested over its registry.
OTHERS = {
    "backends", "integrate_many",
    "ring_of_lights", "dct_dictionary", "terrain", "guess_convention", "build", "load", "save", "load_camera",
    "load_field", "load_height", "load_mask", "load_photographs", "save_normals", "save_height", "save_mesh",
    "compare_heights", "hillshade", "page_html", "surface_page", "surface_preview",
}  # fmt: skip
_CAST = torch.empty(0).device.type


def test_no_function_is_left_out():
    """A new public function, or class that is called, is in one of the two tables."""
    public = {name: getattr(torchdls, name) for name in torchdls.__all__ if name != "__version__"}
    functions = {name for name, value in public.items() if inspect.isfunction(value)}
    assert functions <= CALLS.keys() | OTHERS
    assert not CALLS.keys() & OTHERS


@pytest.mark.parametrize("name", CALLS)
def test_inside_equals_outside(name):
    f, *tensors = CALLS[name]
    halves = [t.bfloat16() for t in tensors]
    results = []
    for inside, backward in ((False, False), (True, False), (True, True)):
        leaves = [t.clone().requires_grad_() for t in tensors]
        with torch.autocast(_CAST, torch.bfloat16, enabled=inside):
            out = f(*(t.clone() for t in leaves))
        with torch.autocast(_CAST, torch.bfloat16, enabled=backward):
            if out.requires_grad:
                (out * torch.linspace(-1, 1, out.numel()).view_as(out)).sum().backward()
        results.append([out.detach(), *(t.grad for t in leaves)])
    for within in results[1:]:
        for a, b in zip(results[0], within, strict=True):
            assert (a is None) == (b is None)
            assert a is None or (a.dtype == b.dtype and torch.equal(a, b))
    with torch.autocast(_CAST, torch.bfloat16):
        taken = f(*halves)
    expected = f(*(t.float() for t in halves))
    assert taken.dtype == expected.dtype
    assert torch.equal(taken.nan_to_num(7.0) if taken.is_floating_point() else taken,
                       expected.nan_to_num(7.0) if expected.is_floating_point() else expected)  # fmt: skip


def test_surfaces_are_made_in_full_precision():
    def made() -> list[Surface]:
        return [torchdls.SURFACES["peaks"](16), torchdls.terrain(16), torchdls.SURFACES["sphere"](16)]

    outside = made()
    with torch.autocast(_CAST, torch.bfloat16):
        inside = made()
    for a, b in zip(inside, outside, strict=True):
        assert torch.equal(a.height, b.height)
        assert torch.equal(a.gradient, b.gradient)


def test_every_kind_of_autocast_is_switched_off():
    """Of devices that are not here too: a model may run under one of them and integrate on the CPU."""
    seen: list[bool] = []

    @full_precision
    def look(x, *, more):
        seen.extend(torch.is_autocast_enabled(device) for device in ("cpu", "cuda"))
        return x, more

    with torch.autocast("cpu", torch.bfloat16):
        was = torch.is_autocast_enabled("cuda")
        torch.set_autocast_enabled("cuda", True)
        try:
            x, more = look(torch.ones(1).half(), more=(torch.ones(1).bfloat16(), torch.ones(1).double(), "word"))
            assert torch.is_autocast_enabled("cuda")
        finally:
            torch.set_autocast_enabled("cuda", was)
        assert torch.is_autocast_enabled("cpu")
    assert seen == [False, False]
    assert x.dtype == more[0].dtype == F32
    assert more[1].dtype == torch.float64
    assert more[2] == "word"
    assert look(torch.ones(1).half(), more=None)[0].dtype == torch.float16
