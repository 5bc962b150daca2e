"""Folders as a practitioner has them, of surfaces that are known: what the tutorial's commands are run on."""

import kornia
import numpy as np
import torch
from PIL import Image

from tests.photometric.test_lights import ball
from torchdls import gradient_to_normals, render, ring_of_lights
from torchdls.surfaces import SURFACES


def write_16_bits(path, picture):
    """(C, H, W) from 0 to 1, as a picture of three channels."""
    codes = (picture.double().clamp(0, 1) * 65535).round().numpy().astype(np.uint16)
    kornia.io.write_image(path, torch.from_numpy(codes).expand(3, -1, -1).contiguous())


def write_mask(path, mask):
    """(H, W) bool, white and black."""
    Image.fromarray((mask.numpy() * 255).astype(np.uint8)).save(path)


def disk(n):
    """(n, n) bool, most of the image."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64),) * 2, indexing="ij")
    return x.square() + y.square() < 0.93


def write_normal_map(folder, n=96, noise=0.0):
    """normal_map.png of 16 bits, mask.png and K.txt; the depth (n, n) that they are of, and the mask.

    The depth is Z = 2 exp(-h / n) for a height h of `peaks`; the normals are cross products of the derivatives of the
    points Z K^-1 (column, row, 1), and so owe nothing to the library's own formula.
    """
    folder.mkdir(parents=True, exist_ok=True)
    surface, f, c = SURFACES["peaks"](n, dtype=torch.float64), 1.5 * n, (n - 1) / 2
    Z = 2 * torch.exp(-surface.height[0, 0] / n)
    Z_x, Z_y = -Z * surface.gradient[0] / n
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) - c,) * 2, indexing="ij")
    ray = torch.stack([x / f, y / f, torch.ones_like(x)])
    along_x = Z_x * ray + Z * torch.tensor([1 / f, 0, 0], dtype=torch.float64)[:, None, None]
    along_y = Z_y * ray + Z * torch.tensor([0, 1 / f, 0], dtype=torch.float64)[:, None, None]
    normals = -torch.linalg.cross(along_x, along_y, dim=0)  # towards the camera: x right, y down, z forward
    normals = normals * torch.tensor([1.0, -1, -1], dtype=torch.float64)[:, None, None]  # y up, z to the viewer
    normals += noise * normals.norm(dim=0) * torch.randn(3, n, n, generator=torch.Generator().manual_seed(0))
    write_16_bits(folder / "normal_map.png", (normals / normals.norm(dim=0) + 1) / 2)
    write_mask(folder / "mask.png", disk(n))
    np.savetxt(folder / "K.txt", [[f, 0, c], [0, f, c], [0, 0, 1]])
    return Z, disk(n)


def write_photographs(folder, n=96, snr_db=40.0):
    """Ten photographs of a thing beside a mirror ball, mask.png and ball_mask.png; the height (n, n) and its mask."""
    folder.mkdir(parents=True, exist_ok=True)
    surface, lights = SURFACES["peaks"](n, dtype=torch.float64), ring_of_lights(10, dtype=torch.float64)
    noise = torch.Generator().manual_seed(0)
    images = render(gradient_to_normals(surface.gradient), lights, 0.8, snr_db=snr_db, generator=noise)[0]
    nothing, half = torch.zeros(n, n, dtype=torch.bool), (n - 1) / 2
    for k, (image, light) in enumerate(zip(images, lights, strict=True)):
        mirror, on_ball = ball(light, n=n, radius=0.4 * n, centre=(half, half))
        write_16_bits(folder / f"photo{k + 1}.png", torch.cat([torch.where(disk(n), image, 0.02), mirror], 1)[None])
    write_mask(folder / "mask.png", torch.cat([disk(n), nothing], 1))
    write_mask(folder / "ball_mask.png", torch.cat([nothing, on_ball], 1))
    return surface.height[0, 0], disk(n)
