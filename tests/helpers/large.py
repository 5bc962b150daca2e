"""Noisy slopes and masks for surfaces out of core, and the surface in memory."""

import numpy as np
import torch

from torchdls import LeastSquares, SoupDIL
from torchdls.surfaces import SURFACES

BLOCK = SoupDIL(order="block")


def field(h, w, dtype=np.float64):
    rng = np.random.default_rng(h * w)
    g = SURFACES["peaks"](max(h, w), dtype=torch.float64).gradient[0, :, :h, :w].numpy()
    return (g + 0.3 * rng.normal(size=g.shape)).astype(dtype)


def whole(g, **options):
    return LeastSquares(**options)(torch.from_numpy(np.ascontiguousarray(g)))[0].numpy()


def disk_ring_and_specks(h, w):
    y, x = np.mgrid[:h, :w]
    radius = np.hypot(y - h / 2, x - w / 2)
    mask = (radius < 0.3 * min(h, w)) | ((radius > 0.36 * min(h, w)) & (radius < 0.48 * min(h, w)))
    mask |= np.random.default_rng(0).random((h, w)) < 0.02
    return mask & (x != w // 2 + 3)
