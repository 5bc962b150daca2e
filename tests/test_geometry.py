"""Conversions are checked against analytic surfaces, autograd of their formulas, and kornia's own normals."""

import itertools

import kornia
import numpy as np
import pytest
import torch
from torch import nn

from torchdls.geometry import (
    GRADIENT_CONVENTIONS,
    NORMAL_CONVENTIONS,
    GradientToNormals,
    NormalsToGradient,
    convert_gradient,
    convert_normals,
    depth_to_points,
    gradient_to_normals,
    guess_convention,
    height_to_points,
    log_depth_to_depth,
    normals_to_gradient,
)

F64 = torch.float64


def grid(h=9, w=12):
    """Columns and rows, x to the right and y down."""
    return torch.arange(w, dtype=F64).expand(h, w), torch.arange(h, dtype=F64)[:, None].expand(h, w)


def twisted(h=24, w=30):
    """A smooth surface with z_xy far from 0: height, its slopes to the right and down."""
    x, y = (g.clone().requires_grad_() for g in grid(h, w))
    z = 2 * torch.sin(x / 4) * torch.cos(y / 5) + 0.01 * x * y
    gx, gy = torch.autograd.grad(z.sum(), (x, y))
    return z.detach()[None, None], torch.stack([gx, gy])[None]


def camera(fx=50.0, fy=55.0, cx=5.3, cy=4.1, skew=0.7):
    return torch.tensor([[fx, skew, cx], [0, fy, cy], [0, 0, 1]], dtype=F64)


def sphere_depth(columns, rows, k, centre=(0.1, -0.2, 8.0), radius=5.0):
    """Nearer intersection of the pixel's ray with a sphere, by the quadratic formula."""
    ray = torch.einsum("ij,jhw->ihw", torch.linalg.inv(k), torch.stack([columns, rows, torch.ones_like(rows)]))
    centre = torch.tensor(centre, dtype=F64)
    a, b, c = (ray**2).sum(0), torch.einsum("ihw,i->hw", ray, centre), centre @ centre - radius**2
    z = (b - (b * b - a * c).sqrt()) / a
    return z, (z * ray - centre[:, None, None]) / radius


# --- conventions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "convention, normal",
    [
        # A ramp that rises to the right by 1/2 and falls down the rows by 1/4: n ~ (-1/2, -1/4, 1) with y up.
        ("opengl", (-0.5, -0.25, 1.0)),
        ("directx", (-0.5, 0.25, 1.0)),
        ("opencv", (-0.5, 0.25, -1.0)),
        ("kornia", (0.5, -0.25, 1.0)),
        ("matlab", (0.25, -0.5, 1.0)),
    ],
)
def test_ramp_in_every_normal_convention(convention, normal):
    n = torch.tensor(normal, dtype=F64)[:, None, None].expand(3, 4, 5)
    gradient, mask, invalid = normals_to_gradient(n, convention)
    torch.testing.assert_close(gradient[0], torch.full((4, 5), 0.5, dtype=F64))
    torch.testing.assert_close(gradient[1], torch.full((4, 5), -0.25, dtype=F64))
    assert mask.all()
    assert mask.shape == (1, 4, 5)
    assert invalid == 0
    torch.testing.assert_close(gradient_to_normals(gradient, convention), n / n[:, :1, :1].norm())


@pytest.mark.parametrize(
    "convention, components",
    [("image", (0.5, -0.25)), ("cartesian", (0.5, 0.25)), ("depth", (-0.5, 0.25)), ("matlab", (-0.25, 0.5))],
)
def test_ramp_in_every_gradient_convention(convention, components):
    g = torch.tensor(components, dtype=F64)[:, None, None].expand(2, 3, 3)
    image = torch.tensor([0.5, -0.25], dtype=F64)[:, None, None].expand(2, 3, 3)
    torch.testing.assert_close(convert_gradient(g, convention), image)
    torch.testing.assert_close(convert_gradient(image, target=convention), g)


@pytest.mark.parametrize("a, b", list(itertools.permutations(NORMAL_CONVENTIONS, 2)))
def test_conversions_invert_each_other(a, b):
    n = torch.randn(2, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(convert_normals(convert_normals(n, a, b), b, a), n, rtol=0, atol=0)


def test_gradient_conversions_invert_each_other():
    g = torch.randn(2, 2, 4, 5, generator=torch.Generator().manual_seed(0))
    for a, b in itertools.permutations(GRADIENT_CONVENTIONS, 2):
        torch.testing.assert_close(convert_gradient(convert_gradient(g, a, b), b, a), g, rtol=0, atol=0)


def test_kornia_normals_of_a_depth_map():
    x, y = grid(40, 40)
    k = camera(cx=20, cy=19, skew=0)
    z, _ = sphere_depth(x, y, k)
    normals = kornia.geometry.depth_to_normals(z[None, None], k[None])
    gradient = normals_to_gradient(normals, "kornia", camera=k).gradient
    exact = torch.stack(torch.gradient(z.log(), dim=(1, 0)))
    torch.testing.assert_close(gradient[0, :, 2:-2, 2:-2], exact[:, 2:-2, 2:-2], rtol=0, atol=1e-4)


@pytest.mark.parametrize("true, other", [("opengl", "directx"), ("directx", "opengl")])
def test_guess_tells_opengl_from_directx(true, other):
    _, gradient = twisted()
    noisy = gradient + 0.02 * torch.randn(gradient.shape, dtype=F64, generator=torch.Generator().manual_seed(1))
    guess = guess_convention(gradient_to_normals(noisy, true))
    assert guess.convention == true
    assert guess.residual[true] < 0.5 < guess.residual[other]


def test_guess_on_a_plane_does_not_tell():
    n = torch.tensor([0.1, 0.2, 1.0])[:, None, None].expand(3, 8, 8)
    assert guess_convention(n).residual == {"opengl": 0.0, "directx": 0.0}


def test_guess_skips_candidates_without_valid_pixels_and_ignores_the_outside():
    _, gradient = twisted()
    n = gradient_to_normals(gradient, "opencv")
    mask = torch.ones(1, 1, 24, 30, dtype=torch.bool)
    mask[..., :6] = False
    n[..., :6] = float("nan")
    guess = guess_convention(n, mask, candidates=("opengl", "opencv"))
    assert guess.convention == "opencv"
    assert guess.residual["opengl"] == float("inf")
    with pytest.raises(ValueError, match="no 2x2 cell of valid pixels"):
        guess_convention(n, candidates=("opengl", "directx"))


# --- invalid pixels ------------------------------------------------------------------------------------------------


def bad_normals():
    n = torch.tensor([0.1, 0.2, 1.0], dtype=F64)[:, None, None].repeat(1, 3, 4)[None].repeat(2, 1, 1, 1)
    bad = {
        (0, 0): (0, 0, 0),
        (0, 1): (1, 0, 0),
        (1, 1): (0.1, 0.1, -1),
        (1, 2): (float("nan"), 0, 1),
        (2, 2): (0, float("inf"), 1),
        (2, 3): (1, 0, 1e-9),
    }
    for (row, column), value in bad.items():
        n[0, :, row, column] = torch.tensor(value, dtype=F64)
    return n, bad


def test_invalid_pixels_are_found_counted_and_filled_with_zero():
    n, bad = bad_normals()
    before = n.clone()
    gradient, mask, invalid = normals_to_gradient(n)
    assert invalid.tolist() == [len(bad), 0]
    assert {tuple(p) for p in (~mask[0, 0]).nonzero().tolist()} == set(bad)
    assert (gradient[~mask.expand_as(gradient)] == 0).all()
    torch.testing.assert_close(n, before, equal_nan=True, rtol=0, atol=0)


def test_invalid_pixels_outside_the_mask_are_not_counted():
    n, _ = bad_normals()
    mask = torch.ones(2, 1, 3, 4, dtype=torch.bool)
    mask[:, :, 0] = False
    result = normals_to_gradient(n, mask=mask)
    assert result.invalid.tolist() == [4, 0]
    assert not result.mask[:, :, 0].any()
    assert (result.gradient[:, :, 0] == 0).all()


@pytest.mark.parametrize("k", [None, camera()])
def test_no_nan_in_derivatives_at_invalid_pixels(k):
    n, _ = bad_normals()
    n.requires_grad_()
    gradient, mask, _ = normals_to_gradient(n, camera=k)
    gradient.square().sum().backward()
    assert n.grad.isfinite().all()
    assert (n.grad[~mask.expand_as(n)] == 0).all()
    assert (n.grad[mask.expand_as(n)] != 0).any()


def test_only_the_direction_counts():
    n, _ = bad_normals()
    one, other = normals_to_gradient(n[1:]), normals_to_gradient(n[1:] * 1e-5)
    torch.testing.assert_close(one.gradient, other.gradient)
    huge = normals_to_gradient(n[1:].float() * 1e30)  # the square would overflow
    torch.testing.assert_close(huge.gradient, one.gradient.float())
    assert huge.mask.all()


def test_eps_is_the_cosine_of_the_grazing_angle():
    angle = torch.deg2rad(torch.tensor([[80.0, 84.0, 85.0, 89.0]], dtype=F64))
    n = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()])
    mask = normals_to_gradient(n, eps=torch.deg2rad(torch.tensor(84.5)).cos().item()).mask
    assert mask[0, 0].tolist() == [True, True, False, False]


# --- pixel size ----------------------------------------------------------------------------------------------------


def test_pixel_size_gives_the_rise_per_pixel_and_back():
    n = torch.tensor([-0.5, -0.25, 1.0], dtype=F64)[:, None, None].expand(3, 2, 2)
    gradient = normals_to_gradient(n, pixel_size=(2.0, 4.0)).gradient
    assert gradient[:, 0, 0].tolist() == [1.0, -1.0]
    torch.testing.assert_close(gradient_to_normals(gradient, pixel_size=(2.0, 4.0)), n / n[:, 0, 0].norm())


def test_points_of_a_height():
    points = height_to_points(torch.full((1, 2, 3), 7.0), (2.0, 0.5))
    assert points[:, 1, 2].tolist() == [4.0, -0.5, 7.0]
    assert points[:, 0, 0].tolist() == [0.0, 0.0, 7.0]


# --- perspective camera --------------------------------------------------------------------------------------------


def test_perspective_plane_has_the_closed_form_log_depth():
    k, (x, y) = camera(), grid()
    n, d = torch.tensor([0.2, -0.3, -1.0], dtype=F64), -6.0  # n.X = d in the camera frame
    covector = torch.linalg.inv(k).T @ n
    depth = d / (covector[0] * x + covector[1] * y + covector[2])
    normals = n[:, None, None].expand(3, 9, 12)
    gradient, mask, _ = normals_to_gradient(normals, "opencv", camera=k)
    for part, dim in zip(gradient, (-1, -2), strict=True):  # for a plane 1/Z is linear, so its slope is exact
        step = (1 / depth).diff(dim=dim).mean()
        torch.testing.assert_close(part, -depth * step)
    assert mask.all()
    torch.testing.assert_close(gradient_to_normals(gradient, "opencv", camera=k), normals / n.norm())


def test_perspective_sphere_against_autograd_of_its_depth():
    k = camera(cx=15, cy=12)
    x, y = (g.clone().requires_grad_() for g in grid(24, 30))
    depth, normals = sphere_depth(x, y, k)
    exact = torch.stack(torch.autograd.grad(depth.log().sum(), (x, y)))
    gradient, mask, _ = normals_to_gradient(normals.detach(), "opencv", camera=k)
    assert mask.all()
    torch.testing.assert_close(gradient, exact)
    torch.testing.assert_close(gradient_to_normals(exact, "opencv", camera=k), normals.detach())


def test_depth_of_the_sphere_comes_back():
    k, (x, y) = camera(cx=15, cy=12), grid(24, 30)
    depth, normals = sphere_depth(x, y, k)
    gx, gy = normals_to_gradient(normals, "opencv", camera=k).gradient
    down = torch.cumulative_trapezoid(gy[:, 0], dim=0)
    first = torch.cat([torch.zeros(1, dtype=F64), down])[:, None]
    log_depth = torch.cat([first, first + torch.cumulative_trapezoid(gx, dim=1)], 1)
    found = log_depth_to_depth(log_depth, scale=depth[0, 0])
    torch.testing.assert_close(found, depth, rtol=2e-4, atol=0)
    points = depth_to_points(found[None], k)
    centre = torch.tensor([0.1, 0.2, -8.0], dtype=F64)  # y up, z to the viewer
    radius = (points - centre[:, None, None]).norm(dim=0)
    torch.testing.assert_close(radius, torch.full_like(radius, 5.0), rtol=1e-3, atol=0)


def test_a_long_lens_is_orthographic():
    _, gradient = twisted()
    normals = gradient_to_normals(gradient)
    f = 1e6
    k = camera(f, f, 15, 12, 0)
    log_slope = normals_to_gradient(normals, camera=k).gradient
    # One pixel covers Z/f at depth Z, and depth falls where height rises.
    torch.testing.assert_close(-f * log_slope, gradient, rtol=1e-3, atol=1e-4)


def test_one_camera_per_surface():
    _, gradient = twisted()
    normals = gradient_to_normals(gradient).repeat(2, 1, 1, 1)
    cameras = torch.stack([camera(), camera(80, 70, 3, 4)])
    both = normals_to_gradient(normals, camera=cameras).gradient
    for i in range(2):
        torch.testing.assert_close(both[i], normals_to_gradient(normals[i], camera=cameras[i]).gradient)


# --- derivatives and modules ---------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")  # torch's own, under forward mode
def test_gradcheck():
    generator = torch.Generator().manual_seed(3)
    n = torch.randn(1, 3, 2, 3, dtype=F64, generator=generator)
    n[:, 2] = n[:, 2].abs() + 0.5
    g = torch.randn(1, 2, 2, 3, dtype=F64, generator=generator)
    k = camera()
    for t in (n, g, k):
        t.requires_grad_()
    options = {"check_forward_ad": True, "check_batched_grad": True}
    assert torch.autograd.gradcheck(lambda n: normals_to_gradient(n).gradient, n, **options)
    assert torch.autograd.gradcheck(lambda n, k: normals_to_gradient(n, camera=k).gradient, (n, k), **options)
    assert torch.autograd.gradcheck(gradient_to_normals, g, **options)
    assert torch.autograd.gradcheck(lambda g, k: gradient_to_normals(g, camera=k), (g, k), **options)
    assert torch.autograd.gradcheck(
        lambda z, k: depth_to_points(log_depth_to_depth(z), k), (g[:, :1].detach().requires_grad_(), k), **options
    )


def test_modules_chain_and_train_the_camera():
    _, gradient = twisted()
    k = nn.Parameter(camera())
    chain = nn.Sequential(GradientToNormals(camera=k), NormalsToGradient(camera=k), nn.Identity())
    torch.testing.assert_close(chain(gradient), gradient)
    chain[1](gradient_to_normals(gradient)).sum().backward()
    assert k.grad.isfinite().all()
    assert len(list(chain.parameters())) == 1
    module = NormalsToGradient(camera=camera())
    assert set(module.state_dict()) == {"camera"}
    assert "opengl" in repr(NormalsToGradient()) + repr(GradientToNormals())
    assert not NormalsToGradient().state_dict()


def test_batch_equals_single_and_keeps_the_dtype():
    n, _ = bad_normals()
    whole = normals_to_gradient(n.float())
    assert whole.gradient.dtype == torch.float32
    for i in range(2):
        single = normals_to_gradient(n[i].float())
        for a, b in zip(whole, single, strict=True):
            torch.testing.assert_close(a[i], b)


def test_nothing_is_made_on_the_default_device():
    _, gradient = twisted()
    with torch.device("meta"):
        n = gradient_to_normals(gradient)
        field = normals_to_gradient(n)
        assert n.device.type == field.gradient.device.type == "cpu"
        assert height_to_points(gradient[:, :1]).device.type == "cpu"


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error, match, call",
    [
        (ValueError, r"normals \(2, 4, 4\) given", lambda n: normals_to_gradient(n[:2])),
        (ValueError, r"normals \(3, 0, 4\) given", lambda n: normals_to_gradient(n[:, :0])),
        (TypeError, "normals has dtype torch.float16", lambda n: normals_to_gradient(n.half())),
        (TypeError, "normals has dtype torch.int64", lambda n: normals_to_gradient(n.long())),
        (TypeError, "normals is a list", lambda n: normals_to_gradient(n.tolist())),
        (ValueError, "convention: 'gl' is unknown; choose from opengl", lambda n: normals_to_gradient(n, "gl")),
        (ValueError, "convention: 'gl'", lambda n: NormalsToGradient("gl")),
        (ValueError, "target: 'gl'", lambda n: convert_normals(n, target="gl")),
        (ValueError, "source: 'gl'", lambda n: convert_gradient(n[:2], "gl")),
        (ValueError, r"mask \(1, 4, 3\) differ in width", lambda n: normals_to_gradient(n, mask=n[:1, :, :3] > 0)),
        (TypeError, "mask has dtype torch.float32", lambda n: normals_to_gradient(n, mask=n[:1])),
        (ValueError, r"camera: shape \(2, 3, 3\)", lambda n: normals_to_gradient(n, camera=torch.ones(2, 3, 3))),
        (TypeError, "camera: K has dtype torch.int64", lambda n: normals_to_gradient(n, camera=torch.eye(3).long())),
        (ValueError, "camera: K is singular", lambda n: normals_to_gradient(n, camera=torch.zeros(3, 3))),
        (ValueError, "pixel_size: 0", lambda n: normals_to_gradient(n, pixel_size=0)),
        (ValueError, "beside a camera", lambda n: normals_to_gradient(n, camera=torch.eye(3), pixel_size=2.0)),
        (ValueError, "eps: 1.5", lambda n: normals_to_gradient(n, eps=1.5)),
        (ValueError, r"gradient \(3, 4, 4\) given", gradient_to_normals),
        (ValueError, r"depth \(3, 4, 4\) given", lambda n: depth_to_points(n, torch.eye(3))),
        (ValueError, r"height \(3, 4, 4\) given", height_to_points),
    ],
)
def test_bad_input_names_the_argument(error, match, call):
    with pytest.raises(error, match=match):
        call(torch.ones(3, 4, 4))


@pytest.mark.parametrize("camera", [None, torch.tensor([[40.0, 0, 8], [0, 40.0, 7], [0, 0, 1]]).double()])
def test_the_residual_of_each_reading_is_that_of_its_own_slopes(camera):
    """Readings that differ by signs share their slopes; against each by itself, in NumPy."""
    generator = torch.Generator().manual_seed(0)
    normals = torch.randn(2, 3, 12, 15, generator=generator, dtype=torch.float64)
    normals[:, 2] = normals[:, 2].sign() * (0.3 + normals[:, 2].abs())
    names, curl, scale = list(NORMAL_CONVENTIONS), {}, 0.0
    for name in names:
        field = normals_to_gradient(normals, name, camera=camera)
        good, (p, q) = field.mask[:, 0].numpy(), field.gradient.numpy().swapaxes(0, 1)
        cells = good[:, 1:, 1:] & good[:, 1:, :-1] & good[:, :-1, 1:] & good[:, :-1, :-1]
        a = np.diff((q[:, 1:] + q[:, :-1]) / 2, axis=2)[cells]
        b = np.diff((p[:, :, 1:] + p[:, :, :-1]) / 2, axis=1)[cells]
        curl[name] = np.abs(a - b).sum() if cells.any() else np.inf
        scale = max(scale, (np.abs(a) + np.abs(b)).sum())
    found = guess_convention(normals, candidates=names, camera=camera)
    assert found.residual == pytest.approx({name: value / scale for name, value in curl.items()}, rel=1e-12)
