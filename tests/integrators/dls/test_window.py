"""DLS within the window of the live patches finds what it finds on the whole image."""

import pytest
import torch

from torchdls import DLS, Exact, Patches
from torchdls.integrators.base import Fields
from torchdls.integrators.dls import integrator as dls_module
from torchdls.integrators.dls.window import live_window


@pytest.mark.parametrize("length", [8, 13, 18])
@pytest.mark.parametrize(("size", "stride"), [(8, 2), (5, 3), (4, 4), (3, 1)])
def test_the_window_has_just_the_patches_that_touch_a_valid_pixel(length, size, stride):
    patches = Patches(size, stride)
    where = torch.arange(length * 12.0).view(1, 1, length, 12)
    for low in range(length):
        for high in range(low, length):
            mask = torch.zeros(1, 1, length, 12, dtype=torch.bool)
            mask[:, :, low : high + 1, 1] = mask[:, :, low : high + 1, 10] = True
            window = live_window(mask, patches)
            rows, columns = patches.grid(where.shape)
            all_patches = patches.extract(where).unflatten(-1, (rows, columns))
            touched = (patches.extract(mask.double()) > 0).any(1).unflatten(-1, (rows, columns))[0].any(1)
            cut = where if window is None else where[(..., *window.pixels)]
            torch.testing.assert_close(patches.extract(cut), all_patches[:, :, touched].flatten(-2))
            if window is not None:
                codes = window.put_codes_back(patches.extract(cut))
                kept = torch.where(touched[:, None], all_patches, 0).flatten(-2)
                torch.testing.assert_close(codes, kept)


def test_dls_is_the_same_within_the_window_and_without(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(2, 2, 31, 40, generator=generator, dtype=torch.float64)
    mask = torch.zeros(2, 1, 31, 40, dtype=torch.bool)
    mask[0, :, 4:15, 10:22] = True
    mask[1, :, 9:18, 13:29] = torch.rand(9, 16, generator=generator) > 0.1
    method = DLS(n_iter=4, tol=0, height_step=Exact(1e-13))
    within = method.solve(gradient, mask)
    monkeypatch.setattr(dls_module, "live_window", lambda mask, patches: None)
    without = method.solve(gradient, mask)
    for name in ("height", "codes", "dictionary", "objective", "mu"):
        torch.testing.assert_close(getattr(within, name), getattr(without, name), rtol=0, atol=1e-7)


def test_crop_leaves_numbers_and_absent_fields_alone():
    mask = torch.zeros(1, 1, 20, 20, dtype=torch.bool)
    mask[..., 3:6, 3:6] = True
    window = live_window(mask, Patches(8, 2))
    number = torch.full((1, 1, 1, 1), 2.0)
    cropped = window.crop(Fields(torch.zeros(1, 2, 20, 20), mask, None, torch.zeros(1, 1, 20, 20), number, (1.0, 1.0)))
    assert cropped.weight is None
    assert cropped.anchor_weight is number
    assert cropped.gradient.shape[-2:] == cropped.mask.shape[-2:] == cropped.anchor.shape[-2:] == (12, 12)
    assert window.put_back(cropped.mask.float()).shape == (1, 1, 20, 20)
