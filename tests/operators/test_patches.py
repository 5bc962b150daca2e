"""Patches against loops: every pixel covered at every size, the exact transpose, the coverage."""

import itertools

import pytest
import torch

from tests.helpers import assert_adjoint, random_field
from torchdls import Patches

CASES = [
    (8, 2, (8, 8)),
    (8, 2, (63, 63)),
    (8, 2, (21, 16)),
    (8, 8, (17, 25)),
    (4, 3, (11, 9)),
    ((2, 3), (1, 2), (7, 8)),
    ((3, 1), (2, 1), (4, 5)),
    (3, 3, (3, 10)),
    (1, 1, (2, 3)),
    ((8, 5), (3, 4), (23, 22)),
    (5, 4, (13, 14)),
]


def starts(m, size, stride):
    """First pixel of each patch along an axis: the regular ones, and one flush with the end if they do not reach it."""
    regular = list(range(0, m - size + 1, stride))
    return regular if regular[-1] + size == m else [*regular, m - size]


@pytest.mark.parametrize("size, stride, shape", CASES, ids=str)
def test_extract_adjoint_and_coverage(size, stride, shape):
    patches = Patches(size, stride)
    (p, q), (s, t) = patches.size, patches.stride
    corners = list(itertools.product(starts(shape[0], p, s), starts(shape[1], q, t)))
    z = random_field(2, 1, *shape)
    expected = torch.stack([z[:, 0, r : r + p, c : c + q].flatten(1) for r, c in corners], -1)
    X = patches.extract(z)
    assert X.shape == (2, patches.n_pixels, len(corners))
    assert patches.grid(shape)[0] * patches.grid(z.shape)[1] == len(corners)
    torch.testing.assert_close(X, expected, rtol=0, atol=0)
    assert_adjoint(patches.extract, lambda Y: patches.adjoint(Y, shape), z, random_field(*X.shape, seed=1))
    coverage = patches.coverage(shape, dtype=z.dtype)
    assert coverage.min() >= 1
    torch.testing.assert_close(patches.adjoint(X, z.shape), coverage * z)


def test_every_pixel_is_covered_at_every_size():
    for size, m in itertools.product(range(1, 9), range(1, 30)):
        for stride in range(1, size + 1):
            if m >= size:
                coverage = Patches((size, 1), (stride, 1)).coverage((m, 1), dtype=torch.float32)
                assert coverage.min() >= 1, (size, stride, m)


@pytest.mark.parametrize(
    "size, stride, message",
    [
        (0, 1, "size: 0 given"),
        (8, 0, "stride: 0 given"),
        (4, 5, "stride: .5, 5. exceeds the patch size .4, 4."),
        ((4, 2), (2, 3), "uncovered"),
        (2.5, 1, "size: 2.5 given"),
        ((8, 8, 8), 1, "size"),
        (True, 1, "size: True given"),
        (None, 1, "size: None given"),
        ("88", 1, "size"),
    ],
)
def test_bad_settings_are_named(size, stride, message):
    with pytest.raises((ValueError, TypeError), match=message):
        Patches(size, stride)


def test_an_image_smaller_than_a_patch_is_refused():
    with pytest.raises(ValueError, match="7 x 20 pixels is smaller than a patch of 8 x 8"):
        Patches(8, 2).extract(torch.zeros(1, 1, 7, 20))
