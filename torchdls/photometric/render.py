"""Images of a surface under distant lights: matte, with shadows, highlights and noise on request."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from torchdls._checks import check_dtype, check_field, check_fit, check_real
from torchdls._precision import full_precision
from torchdls.operators import as_pixel_size
from torchdls.photometric.model import check_lights, count_of, shading


def ring_of_lights(
    count: int = 10, tilt: float = 30.0, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """Directions (count, 3) of lights on a ring, `tilt` degrees from the viewer; the first to the right.

    ValueError unless there are at least three lights and the tilt is between 0 and 90 degrees; TypeError for a dtype
    other than float32 and float64.

    Example:
        >>> torchdls.ring_of_lights(3, tilt=30).round(decimals=2)
        tensor([[ 0.5000,  0.0000,  0.8700],
                [-0.2500,  0.4300,  0.8700],
                [-0.2500, -0.4300,  0.8700]])
    """
    check_dtype("ring_of_lights", dtype)
    if count < 3 or not 0 < tilt < 90:
        raise ValueError(f"count={count!r}, tilt={tilt!r}: at least 3 lights between 0 and 90 degrees are needed")
    turn = torch.arange(count, dtype=torch.float64, device="cpu") * (2 * math.pi / count)
    side, up = math.sin(math.radians(tilt)), math.cos(math.radians(tilt))
    lights = torch.stack([side * turn.cos(), side * turn.sin(), torch.full_like(turn, up)], 1)
    return lights.to(dtype).to(device)


@full_precision
def render(
    normals: Tensor,
    lights: Tensor,
    albedo: Tensor | float = 1.0,
    *,
    shadow: Tensor | None = None,
    highlight: float = 0.0,
    shininess: float = 30.0,
    snr_db: float | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""One image per light.

        I_k = albedo max(0, l_k . n) + highlight |l_k| max(0, h_k . n)^shininess [l_k . n > 0]

    with h_k the unit vector half way between the light and the viewer; black in `shadow`. Then white gaussian noise of
    deviation rms(I) 10^(-SNR/20), rms over all images of a surface. Without highlights the surface is Lambertian, with
    attached shadows. Differentiable.

    Args:
        normals: (N, 3, H, W) or (3, H, W), canonical, of length 1.
        lights: (K, 3) or (N, K, 3), x right, y up, z to the viewer; their length is their strength.
        albedo: a number, or (N, 1, H, W).
        shadow: (N, K, H, W) bool, such as `cast_shadows(height, lights)`.
        highlight: strength of the mirror-like part (Blinn's), at least 0.
        shininess: how narrow the highlights are, positive.
        snr_db: signal-to-noise ratio in decibels; None for no noise.
        generator: the source of the noise.

    Returns:
        Images (N, K, H, W), or (K, H, W) for unbatched normals.

    Raises:
        TypeError: normals or lights are not float32 or float64, the albedo is of another dtype than the normals, or
            the shadow is not bool.
        ValueError: a shape does not fit, or an option is out of range.

    Example:
        >>> lights = torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
        >>> facing = torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1)
        >>> torchdls.render(facing, lights, albedo=0.5).flatten()
        tensor([0.5000, 0.4000, 0.4000])
    """
    check_field("render", "normals", normals, 3)
    if not highlight >= 0 or not shininess > 0 or (snr_db is not None and not math.isfinite(snr_db)):
        raise ValueError(
            f"render: highlight={highlight!r} must be at least 0, shininess={shininess!r} positive and "
            f"snr_db={snr_db!r} None or finite"
        )
    n = normals if normals.ndim == 4 else normals[None]
    lights = check_lights("render", lights, n, count=count_of(lights))
    lambert = shading(n, lights)
    _check_beside(normals, albedo, shadow, lights.shape[-2])
    images = albedo * lambert.clamp(min=0)
    if highlight:
        strength = lights.norm(dim=-1, keepdim=True)
        half = normalize(
            lights / strength + torch.tensor([0.0, 0.0, 1.0], dtype=lights.dtype, device=lights.device), dim=-1
        )
        gloss = shading(n, half).clamp(min=0) ** shininess
        images = images + highlight * strength[..., None] * torch.where(lambert > 0, gloss, 0)
    if shadow is not None:
        images = torch.where(shadow, 0, images)
    if snr_db is not None:
        sigma = images.detach().square().mean((-3, -2, -1), keepdim=True).sqrt() * 10 ** (-snr_db / 20)
        source = "cpu" if generator is None else generator.device
        noise = torch.randn(images.shape, generator=generator, dtype=torch.float64, device=source)
        images = images + sigma * noise.to(images)
    return images if normals.ndim == 4 else images[0]


def _check_beside(normals: Tensor, albedo: Tensor | float, shadow: Tensor | None, count: int) -> None:
    """An albedo, one number or a field, and shadows that fit the normals."""
    if isinstance(albedo, Tensor) and albedo.ndim:
        check_fit("render", "albedo", albedo, normals, "normals", channels=(1,), scalar=True)
    elif isinstance(albedo, Tensor):
        check_real("render", "albedo", albedo)
    if shadow is not None:
        check_fit("render", "shadow", shadow, normals, "normals", channels=(1, count), dtype=torch.bool)


@full_precision
def cast_shadows(height: Tensor, lights: Tensor, pixel_size: float | Sequence[float] = 1.0) -> Tensor:
    """Where the surface itself stands between a pixel and a light.

    Marches from every pixel toward the light in steps of about one pixel, over heights interpolated linearly, until the
    ray is above the highest point. Nothing beyond the image casts a shadow.

    Args:
        height: (N, 1, H, W) or (1, H, W).
        lights: (K, 3) or (N, K, 3), above the horizon (z > 0).
        pixel_size: (dx, dy) or one number, in the unit of the height.

    Returns:
        (N, K, H, W) bool, or (K, H, W); True in the shadow. Attached shadows (l . n <= 0) are `render`'s own.

    Raises:
        TypeError: an argument is not a tensor of float32 or float64.
        ValueError: a shape does not fit, or a light is not above the horizon.

    Example:
        >>> height = torch.zeros(1, 1, 1, 5)
        >>> height[..., 2] = 3.0  # a wall
        >>> torchdls.cast_shadows(height, torch.tensor([[0.6, 0.0, 0.8]]))  # the light stands at the right
        tensor([[[[ True,  True, False, False, False]]]])
    """
    check_field("cast_shadows", "height", height, 1)
    z = (height if height.ndim == 4 else height[None]).detach()
    lights = check_lights("cast_shadows", lights, z, count=count_of(lights))
    if bool((lights[..., 2] <= 0).any()):
        raise ValueError(f"cast_shadows: a light of {tuple(lights.shape)} is not above the horizon (z > 0)")
    steps = as_pixel_size(pixel_size)
    lights = lights.detach().expand(z.shape[0], -1, -1)
    rows = [torch.stack([_shadow(z[i, 0], light, steps) for light in lights[i]]) for i in range(len(z))]
    return torch.stack(rows) if height.ndim == 4 else rows[0]


def _count(lights: Tensor) -> int:
    return lights.shape[-2] if isinstance(lights, Tensor) and lights.ndim > 1 else 0


def _shadow(z: Tensor, light: Tensor, pixel_size: tuple[float, float]) -> Tensor:
    """(H, W) bool of one surface and one light."""
    h, w = z.shape
    # Toward the light, in pixels (rows count down); scaled so that the longer side of a step is one pixel.
    across, down, up = float(light[0]) / pixel_size[0], -float(light[1]) / pixel_size[1], float(light[2])
    longest = max(abs(across), abs(down))
    dark = torch.zeros_like(z, dtype=torch.bool)
    if longest < 1e-6 * up:
        return dark
    across, down, rise = across / longest, down / longest, up / longest
    y = torch.arange(h, dtype=z.dtype, device=z.device)[:, None].expand(h, w)
    x = torch.arange(w, dtype=z.dtype, device=z.device).expand(h, w)
    reach = min(max(h, w) - 1, int(float(z.max() - z.min()) / rise) + 1)
    for step in range(1, reach + 1):
        column, row = x + step * across, y + step * down
        inside = (column >= 0) & (column <= w - 1) & (row >= 0) & (row <= h - 1)
        grid = torch.stack([2 * column / max(w - 1, 1) - 1, 2 * row / max(h - 1, 1) - 1], -1)
        ahead = grid_sample(z[None, None], grid[None], padding_mode="border", align_corners=True)[0, 0]
        dark = dark | (inside & (ahead > z + step * rise + 1e-4 * rise))
    return dark
