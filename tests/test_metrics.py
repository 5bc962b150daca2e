import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from torchdls.metrics import mean_absolute_depth_error, mean_angular_error, rmse, ssim
from torchdls.surfaces import peaks, saddle, vase

MEASURES = {
    "rmse": rmse,
    "ssim": lambda height, reference, mask=None: ssim(height, reference, 2.0, mask),
    "mean_angular_error": mean_angular_error,
    "mean_absolute_depth_error": mean_absolute_depth_error,
}
every_measure = pytest.mark.parametrize("measure", MEASURES.values(), ids=MEASURES)


def pair(n=1, shape=(24, 31), dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    reference = 5 + torch.rand(n, 1, *shape, generator=generator, dtype=dtype)
    return reference + 0.3 * torch.randn(reference.shape, generator=generator, dtype=dtype), reference


def holed_mask(n=1, shape=(24, 31)):
    mask = torch.ones(n, 1, *shape, dtype=torch.bool)
    mask[..., 20:, 5:9] = False
    mask[..., :, 29:] = False
    return mask


def test_rmse_is_the_standard_deviation_of_the_difference():
    height, reference = pair(3)
    expected = (height - reference).flatten(1).std(1, correction=0)
    torch.testing.assert_close(rmse(height, reference), expected)
    torch.testing.assert_close(rmse(height + 7, reference), expected)
    mask = holed_mask(3)
    expected = torch.stack([d[m].std(correction=0) for d, m in zip(height - reference, mask, strict=True)])
    torch.testing.assert_close(rmse(height, reference, mask), expected)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_ssim_equals_scikit_image(dtype, tolerance):
    s = vase(64, dtype=dtype)
    height = s.height + torch.randn(s.height.shape, generator=torch.Generator().manual_seed(0)).to(dtype)
    aligned = height.double() + (s.height.double() - height.double()).mean()
    expected = structural_similarity(
        s.height[0, 0].double().numpy(),
        aligned[0, 0].numpy(),
        data_range=5,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert float(ssim(height, s.height, 5)) == pytest.approx(expected, abs=tolerance)
    assert float(ssim(height - 40, s.height, 5)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("data_range", [1e-200, 1e-9, 1.0, 1e200])
def test_ssim_is_at_most_1_and_that_of_itself(data_range):
    """Flat windows far from 0, whose variances are rounding where they are differences of squares."""
    height = torch.full((1, 1, 24, 24), 1000.1, dtype=torch.float64)
    height[..., 12:] += torch.randn(24, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    other = height.clone()
    other[..., 12:] += 0.1 * torch.randn(24, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert float(ssim(height, height, data_range)) == pytest.approx(1, abs=1e-12)
    assert -1 <= float(ssim(height, other, data_range)) <= 1
    plane = torch.zeros_like(height)
    assert float(ssim(plane, plane, data_range)) == 1


def test_ssim_counts_the_windows_inside_the_mask():
    height, reference = pair()
    mask = holed_mask()
    shift = (reference - height)[mask].mean()
    _, full = structural_similarity(
        reference[0, 0].numpy(),
        (height + shift)[0, 0].numpy(),
        data_range=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    centres = [
        (i, j) for i in range(5, 24 - 5) for j in range(5, 31 - 5) if mask[0, 0, i - 5 : i + 6, j - 5 : j + 6].all()
    ]
    expected = np.mean([full[c] for c in centres])
    assert float(ssim(height, reference, 2.0, mask)) == pytest.approx(expected, abs=1e-12)


def test_angular_error_between_planes_is_the_angle_of_their_normals():
    x, y = torch.arange(9.0).expand(7, 9), torch.arange(7.0)[:, None].expand(7, 9)
    flat, tilted = torch.zeros(1, 1, 7, 9), (math.tan(math.radians(30)) * x)[None, None]
    assert float(mean_angular_error(tilted, flat)) == pytest.approx(30, rel=1e-5)
    assert float(mean_angular_error(2 * tilted, flat, pixel_size=2.0)) == pytest.approx(30, rel=1e-5)
    assert float(mean_angular_error(3 * y[None, None], flat, pixel_size=(1, 3))) == pytest.approx(45, rel=1e-5)
    a, b = (x - 2 * y)[None, None], (0.5 * x + y)[None, None]
    cosine = np.dot([-1, 2, 1], [-0.5, -1, 1]) / np.linalg.norm([-1, 2, 1]) / np.linalg.norm([-0.5, -1, 1])
    assert float(mean_angular_error(a, b)) == pytest.approx(math.degrees(math.acos(cosine)), rel=1e-5)


def test_angular_error_knows_gradients_and_their_orientation():
    quadratic = saddle((20, 33), dtype=torch.float64)
    assert float(mean_angular_error(quadratic.height, quadratic.gradient)) < 1e-6
    smooth = peaks(150)
    assert float(mean_angular_error(smooth.height, smooth.gradient)) < 0.02
    assert float(mean_angular_error(smooth.height, smooth.gradient * torch.tensor([1.0, -1.0]).view(2, 1, 1))) > 5


def test_angular_error_uses_complete_cells():
    height, reference = pair()
    mask = holed_mask()

    def normals(z):
        p = (z[:-1, 1:] - z[:-1, :-1] + z[1:, 1:] - z[1:, :-1]) / 2
        q = (z[1:, :-1] - z[:-1, :-1] + z[1:, 1:] - z[:-1, 1:]) / 2
        n = np.stack([-p, -q, np.ones_like(p)])
        return n / np.linalg.norm(n, axis=0)

    m = mask[0, 0].numpy()
    cells = m[1:, 1:] & m[1:, :-1] & m[:-1, 1:] & m[:-1, :-1]
    cosine = (normals(height[0, 0].numpy()) * normals(reference[0, 0].numpy())).sum(0)
    expected = np.degrees(np.arccos(cosine))[cells].mean()
    assert float(mean_angular_error(height, reference, mask)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("width", [31, 30])
def test_made_scales_by_the_median_ratio(width):
    depth, reference = pair(2, (7, width))
    mask = torch.ones(2, 1, 7, width, dtype=torch.bool)
    mask[0, 0, 2, 3:6] = False
    for i in range(2):
        d, r = depth[i][mask[i]].numpy(), reference[i][mask[i]].numpy()
        expected = np.abs(np.median(r / d) * d - r).mean()
        assert float(mean_absolute_depth_error(depth, reference, mask)[i]) == pytest.approx(expected)
    torch.testing.assert_close(
        mean_absolute_depth_error(3 * depth, reference), mean_absolute_depth_error(depth, reference)
    )


@every_measure
def test_equal_surfaces_are_perfect(measure):
    height, _ = pair(2)
    perfect = 1.0 if measure is MEASURES["ssim"] else 0.0
    torch.testing.assert_close(measure(height, height), torch.full((2,), perfect, dtype=torch.float64))


@every_measure
def test_batches_singles_and_broadcasting(measure):
    height, reference = pair(3)
    mask = holed_mask()
    together = measure(height, reference, mask)
    assert together.shape == (3,)
    for i in range(3):
        single = measure(height[i], reference[i], mask[0])
        assert single.shape == ()
        torch.testing.assert_close(single, together[i])
    torch.testing.assert_close(measure(height, reference[:1])[0], measure(height[:1], reference[:1])[0])


@every_measure
def test_nothing_outside_the_mask_is_read_and_inputs_stay(measure):
    height, reference = pair()
    mask = holed_mask()
    dirty = [torch.where(mask, t, torch.nan) for t in (height, reference)]
    kept = [t.clone() for t in dirty]
    torch.testing.assert_close(measure(*dirty, mask), measure(height, reference, mask))
    for before, after in zip(kept, dirty, strict=True):
        assert torch.equal(before.nan_to_num(nan=-1), after.nan_to_num(nan=-1))


@every_measure
def test_derivatives(measure):
    height, reference = pair(2, (12, 13))
    mask = torch.ones(2, 1, 12, 13, dtype=torch.bool)
    mask[:, :, 0, 12] = False
    height = torch.where(mask, height, torch.nan).requires_grad_()
    (gradient,) = torch.autograd.grad(measure(height, reference, mask).sum(), height)
    assert gradient.isfinite().all()
    assert (gradient[~mask] == 0).all()
    assert torch.autograd.gradcheck(lambda h: measure(h, reference), height.detach().nan_to_num(5.0).requires_grad_())


@pytest.mark.parametrize("name", ["rmse", "mean_angular_error", "ssim"])
def test_derivatives_are_finite_at_the_truth(name):
    _, reference = pair()
    height = reference.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(MEASURES[name](height, reference).sum(), height)
    assert gradient.isfinite().all()


@every_measure
def test_float32_stays_float32(measure):
    height, reference = (t.float() for t in pair())
    value = measure(height, reference)
    assert value.dtype == torch.float32
    torch.testing.assert_close(value.double(), measure(height.double(), reference.double()), rtol=1e-4, atol=1e-5)


@every_measure
def test_bad_input(measure):
    height, reference = pair(2)
    mask = holed_mask(2)
    with pytest.raises(
        ValueError, match=r"(height|depth) \(2, 1, 24, 31\) and reference \(2, 1, 24, 30\) differ in width"
    ):
        measure(height, reference[..., 1:])
    with pytest.raises(ValueError, match=r"mask \(3, 1, 24, 31\)"):
        measure(height, reference, holed_mask(3))
    with pytest.raises(ValueError, match=r"(height|depth) \(24, 31\)"):
        measure(height[0, 0], reference[0, 0])
    with pytest.raises(TypeError, match=r"mask has dtype torch.float64"):
        measure(height, reference, mask.double())
    with pytest.raises(TypeError, match=r"reference has dtype torch.int64"):
        measure(height, reference.long())
    mask[1] = False
    with pytest.raises(ValueError, match="without any valid pixel"):
        measure(height, reference, mask)


def test_bad_windows_and_ranges():
    height, reference = pair(shape=(10, 31))
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(height, reference, 1.0)
    height, reference = pair()
    with pytest.raises(ValueError, match="data_range -1"):
        ssim(height, reference, -1.0)
    thin = torch.zeros_like(height, dtype=torch.bool)
    thin[..., 3, :] = True
    with pytest.raises(ValueError, match="no 11 x 11 window"):
        ssim(height, reference, 1.0, thin)
    with pytest.raises(ValueError, match="no cell of 2 x 2"):
        mean_angular_error(height, reference, thin)
    with pytest.raises(ValueError, match="pixel_size"):
        mean_angular_error(height, reference, pixel_size=0)
