"""Heights straight from images: a polish of any surface by the likelihood of the images themselves."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor

from torchdls._checks import check_fit
from torchdls._precision import full_precision
from torchdls.operators import GradientOperator, as_pixel_size
from torchdls.photometric.model import Samples, check
from torchdls.solvers.cg import conjugate_gradients
from torchdls.solvers.preconditioner import preconditioner

_RIDGE = 1e-6  # part of the mean curvature that holds the constant, which no image sees
_HALVINGS = 8
_CG_TOL, _CG_ITER = 1e-3, 200


class RefineResult(NamedTuple):
    """What `refine` returns; batched as the images.

    Attributes:
        height: (N, 1, H, W), with the mean of the height that came in.
        albedo: (N, 1, H, W), found or given.
        objective: (N, iterations + 1), half the squared misfit of the images, from the start on; it never rises.
        iterations: (N,) the Gauss-Newton steps that each surface took.
        converged: (N,) bool, whether the objective settled to `tol`.

    Example:
        >>> surface, lights = torchdls.SURFACES["peaks"](16), torchdls.ring_of_lights(4)
        >>> images = torchdls.render(torchdls.gradient_to_normals(surface.gradient), lights)
        >>> result = torchdls.refine(surface.height, images, lights, n_iter=3)
        >>> result.height.shape, bool((result.objective.diff() <= 0).all())
        (torch.Size([1, 1, 16, 16]), True)
    """

    height: Tensor
    albedo: Tensor
    objective: Tensor
    iterations: Tensor
    converged: Tensor


class _Scene(NamedTuple):
    """Images (N, K, H, W), lights (N, K, 3), trust (N, 2, K, H, W) of both triangles of a pixel, albedo or None."""

    images: Tensor
    lights: Tensor
    trust: Tensor
    albedo: Tensor | None
    steps: tuple[float, float]

    def slopes(self, z: Tensor) -> Tensor:
        """(N, 2, 2, H, W): of the triangle ahead of each pixel, and of the one behind it."""
        g = GradientOperator("forward", self.steps)(z)
        return torch.stack([g, torch.stack([g[:, 0].roll(1, -1), g[:, 1].roll(1, -2)], 1)], 1)

    def adjoint(self, s: Tensor) -> Tensor:
        """The transpose of `slopes`."""
        behind = torch.stack([s[:, 1, 0].roll(-1, -1), s[:, 1, 1].roll(-1, -2)], 1)
        return GradientOperator("forward", self.steps).adjoint(s[:, 0] + behind)


@full_precision
def refine(
    height: Tensor,
    images: Tensor,
    lights: Tensor,
    *,
    albedo: Tensor | None = None,
    mask: Tensor | None = None,
    lit: Tensor | None = None,
    pixel_size: float | Sequence[float] = 1.0,
    n_iter: int = 30,
    tol: float = 1e-6,
) -> RefineResult:
    r"""The surface under which the images are most likely, by Gauss-Newton steps from one that is near.

        min over z   1/2 \sum_i \sum_k \sum_t (I_ik - albedo_i R_k(g_it))^2,
        R_k(p, q) = max(0, (-l_x p + l_y q + l_z) / sqrt(1 + p^2 + q^2))

    over the pixels i, the images k and the two triangles t whose right angle is at a pixel (pixels ahead, and pixels
    behind), on which the surface is flat; (p, q) are their slopes, down to the right, and y of the lights is up. The
    albedo of a pixel, unless it is given, is the best for its slopes, and is taken out of each step. There are no
    normals between images and height, and so nothing that is not integrable. Each step is solved by conjugate
    gradients and shortened until the objective falls.

    Not differentiable: the result is detached. For gaussian noise of the images it is the maximum-likelihood surface;
    shadows and highlights must be left out by `lit`. Two images are enough where the albedo is known.

    Args:
        height: (N, 1, H, W) or (1, H, W), where to start: what an integrator made of the normals.
        images: (N, K, H, W) or (K, H, W), K at least 3, or 2 where the albedo is given.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        albedo: (N, 1, H, W), known brightness; None to find it.
        mask: (N, 1, H, W) bool, pixels of the object; what lies outside is never read, and stays as it was.
        lit: (N, K, H, W) bool, False where a sample must not be used.
        pixel_size: (dx, dy) or one number, in the unit of the height.
        n_iter: most steps, at least 0.
        tol: a surface stops once a step lowers its objective by less than `tol` of it.

    Returns:
        RefineResult(height, albedo, objective, iterations, converged).

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: a shape does not fit, a value is not finite, or an option is out of range.

    Source: Lee, Kuo, "Shape from photometric ratio and stereo" and "Surface reconstruction from photometric stereo
    images", J. Opt. Soc. Am. A 10, 1993 (triangles, Gauss-Newton); the albedo as Golub, Pereyra 1973.

    Example:
        >>> surface, lights = torchdls.SURFACES["peaks"](24), torchdls.ring_of_lights(6)
        >>> generator = torch.Generator().manual_seed(0)
        >>> normals = torchdls.gradient_to_normals(surface.gradient)
        >>> images = torchdls.render(normals, lights, snr_db=20, generator=generator)
        >>> slopes = torchdls.normals_to_gradient(torchdls.woodham(images, lights).normals).gradient
        >>> height = torchdls.LeastSquares()(slopes)
        >>> better = torchdls.refine(height, images, lights).height
        >>> bool(torchdls.rmse(better, surface.height) < torchdls.rmse(height, surface.height))
        True
    """
    samples = check("refine", images, lights, mask, lit, least=3 if albedo is None else 2)
    check_fit("refine", "height", height, images, "images", channels=(1,), dtype=images.dtype)
    if albedo is not None:
        check_fit("refine", "albedo", albedo, images, "images", channels=(1,), dtype=images.dtype)
    if not isinstance(n_iter, int) or n_iter < 0 or not tol >= 0:
        raise ValueError(f"refine: n_iter={n_iter!r} must be an integer of at least 0, tol={tol!r} at least 0")
    dx, dy = as_pixel_size(pixel_size)
    unit = sqrt(dx * dy)
    with torch.no_grad():
        z = (height if height.ndim == 4 else height[None]).expand(len(samples.images), -1, -1, -1) / unit
        given = None if albedo is None else albedo.expand(len(samples.images), -1, -1, -1)
        found = _descend(z.clone(), _scene(samples, given, mask, (dx / unit, dy / unit)), n_iter, tol)
    found = found._replace(height=found.height * unit)
    single = RefineResult(found.height[0], found.albedo[0], *found[2:])
    return found if samples.batched else single


def _scene(samples: Samples, albedo: Tensor | None, mask: Tensor | None, steps: tuple[float, float]) -> _Scene:
    """Both triangles of a pixel count half, and one alone (at a border) wholly."""
    images = samples.images
    inside = images.new_ones(images.shape[0], 1, *images.shape[-2:])
    if mask is not None:
        inside = inside * mask
    ahead, behind = torch.zeros_like(inside), torch.zeros_like(inside)
    right, down = inside[..., :-1, 1:], inside[..., 1:, :-1]
    ahead[..., :-1, :-1] = inside[..., :-1, :-1] * right * down
    left, up = inside[..., 1:, :-1], inside[..., :-1, 1:]
    behind[..., 1:, 1:] = inside[..., 1:, 1:] * left * up
    pair = torch.stack([ahead, behind], 1)
    pair = pair / pair.sum(1, keepdim=True).clamp(min=1)
    lit = torch.ones_like(images) if samples.lit is None else samples.lit.to(images.dtype)
    lights = samples.lights.expand(len(images), -1, -1)
    return _Scene(images, lights, pair * lit[:, None], albedo, steps)


def _reflect(scene: _Scene, s: Tensor) -> tuple[Tensor, Tensor]:
    """R (N, 2, K, H, W) for slopes (N, 2, 2, H, W), and its derivative (N, 2, K, 2, H, W)."""
    p, q = s[:, :, None, 0], s[:, :, None, 1]
    lx, ly, lz = (scene.lights[:, None, :, i, None, None] for i in range(3))
    length = (1 + p.square() + q.square()).sqrt()
    value = (lz - lx * p + ly * q) / length
    slope = torch.stack([(-lx - value * p / length) / length, (ly - value * q / length) / length], 3)
    shines = value > 0
    return torch.where(shines, value, 0), torch.where(shines[:, :, :, None], slope, 0)


def _best_albedo(scene: _Scene, value: Tensor) -> Tensor:
    if scene.albedo is not None:
        return scene.albedo
    power = (scene.trust * value.square()).sum((1, 2))[:, None]
    product = (scene.trust * value * scene.images[:, None]).sum((1, 2))[:, None]
    return torch.where(power > 0, product / torch.where(power > 0, power, 1), 0)


def _misfit(scene: _Scene, z: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) the objective at z, and the albedo."""
    value, _ = _reflect(scene, scene.slopes(z))
    albedo = _best_albedo(scene, value)
    r = scene.images[:, None] - albedo[:, None] * value
    return 0.5 * (scene.trust * r.square()).sum((1, 2, 3, 4)), albedo


def _step(scene: _Scene, z: Tensor) -> Tensor:
    """The Gauss-Newton step, the albedo projected out pixel by pixel."""
    value, slope = _reflect(scene, scene.slopes(z))
    albedo = _best_albedo(scene, value)
    J, t = albedo[:, None, None] * slope, scene.trust[:, :, :, None]
    r = scene.images[:, None] - albedo[:, None] * value
    rhs = (t * J * r[:, :, :, None]).sum(2)
    power = (scene.trust * value.square()).sum((1, 2))[:, None, None]
    share = 0 if scene.albedo is not None else torch.where(power > 0, 1 / torch.where(power > 0, power, 1), 0)
    mixed = (t * J * value[:, :, :, None]).sum(2)  # what a change of the slopes asks of the albedo

    def normal(s: Tensor) -> Tensor:
        along = (J * s[:, :, None]).sum(3, keepdim=True)
        out = (t * J * along).sum(2)
        return out - mixed * share * (mixed * s).sum((1, 2), keepdim=True)[:, 0:1]

    curvature = (t * J.square()).sum(2)
    w = curvature[:, 0] + torch.stack([curvature[:, 1, 0].roll(-1, -1), curvature[:, 1, 1].roll(-1, -2)], 1)
    level = w.mean((1, 2, 3), keepdim=True).clamp(min=torch.finfo(w.dtype).tiny)
    ridge = _RIDGE * level * torch.ones_like(z)
    w = w + 1e-3 * level * (w.sum((1, 2, 3), keepdim=True) > 0)

    def apply(x: Tensor) -> Tensor:
        return scene.adjoint(normal(scene.slopes(x))) + ridge * x

    b = scene.adjoint(rhs)
    return conjugate_gradients(apply, preconditioner(w, ridge, scene.steps), b, None, tol=_CG_TOL, max_iter=_CG_ITER).x


def _descend(z: Tensor, scene: _Scene, n_iter: int, tol: float) -> RefineResult:
    mean = z.mean((-2, -1), keepdim=True)
    cost, albedo = _misfit(scene, z)
    costs, active = [cost], torch.ones_like(cost, dtype=torch.bool)
    iterations = torch.zeros_like(active, dtype=torch.int64)
    for _ in range(n_iter):
        step, length = _step(scene, z), torch.ones_like(cost)
        better = torch.zeros_like(active)
        for _ in range(_HALVINGS):  # of each surface by itself
            trial = z + length.view(-1, 1, 1, 1) * step
            value, its_albedo = _misfit(scene, trial)
            takes = active & ~better & (value < cost)
            over = takes.view(-1, 1, 1, 1)
            z, albedo = torch.where(over, trial, z), torch.where(over, its_albedo, albedo)
            cost, better = torch.where(takes, value, cost), better | takes
            if bool((better | ~active).all()):
                break
            length = length / 2
        iterations = iterations + active
        active = active & better & (costs[-1] - cost > tol * costs[-1])
        costs.append(cost)
        if not bool(active.any()):
            break
    z = z - z.mean((-2, -1), keepdim=True) + mean
    return RefineResult(z, albedo, torch.stack(costs, 1), iterations, ~active)
