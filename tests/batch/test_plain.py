"""Pictures read together are what each is by itself, to the bit, or are left to the reader of one."""

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers.maps import slopes
from torchdls import gradient_to_normals
from torchdls.batch import Manner, Source, read_map
from torchdls.batch.plain import read_plain
from torchdls.geometry import NORMAL_CONVENTIONS, guess_convention, normals_to_gradient
from torchdls.geometry.normals import convention_residuals
from torchdls.io.packing import unpack, unpack_rgb
from torchdls.surfaces import SURFACES


def picture(gradient, convention="opengl", bits=8):
    normals = gradient_to_normals(gradient, convention)[0].permute(1, 2, 0).numpy()
    return np.rint((normals + 1) / 2 * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


@pytest.mark.parametrize("manner", [Manner(), Manner(double=True), Manner(convention="directx", pixel_size=(2.0, 0.5))])
def test_as_each_by_itself(tmp_path, manner):
    sources = []
    for k, (h, w) in enumerate([(16, 16), (23, 9), (16, 16), (9, 23), (16, 16), (2, 2), (1, 40)]):
        g = slopes(max(h, 2), max(w, 2), k)[..., :h, :w]
        Image.fromarray(picture(g, manner.convention or "opengl")).save(tmp_path / f"{k}.png")
        sources.append(Source(str(tmp_path / f"{k}.png")))
    found = read_plain(sources, manner)
    assert all(found[:5])  # they are plain
    for source, together in zip(sources, found, strict=True):
        if together is not None:
            alone = read_map(source, manner)
            assert together._replace(gradient=0, camera=0) == alone._replace(gradient=0, camera=0)
            assert torch.equal(together.gradient, alone.gradient)
            assert together.gradient.dtype == alone.gradient.dtype


def test_what_is_not_plain_is_left_to_the_reader_of_one(tmp_path):
    g = slopes(16, 16)
    codes = picture(g)
    background, flat, other = (
        codes.copy(),
        codes.copy(),
        picture(SURFACES["peaks"](16, dtype=torch.float32).gradient, "directx"),
    )
    background[:3] = 0
    flat[..., 2] = 128
    alpha = np.concatenate([codes, codes[..., :1]], -1)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    np.save(tmp_path / "g.npy", g[0].numpy())
    sources = [Source(str(broken)), Source(str(tmp_path / "none.png")), Source(str(tmp_path / "g.npy"))]
    for name, array in {"background": background, "flat": flat, "other": other, "alpha": alpha}.items():
        Image.fromarray(array).save(tmp_path / f"{name}.png")
        sources.append(Source(str(tmp_path / f"{name}.png")))
    Image.fromarray(codes).save(tmp_path / "m.png")
    beside = Source(str(tmp_path / "m.png"), mask=str(tmp_path / "m.png"))
    assert read_plain([*sources, beside], Manner()) == [None] * 8
    plain = [Source(str(tmp_path / "m.png"))]
    assert read_plain(plain, Manner())[0] is not None
    for manner in (Manner("rgb"), Manner(convention="auto"), Manner(convention="opencv"), Manner(camera=torch.eye(3))):
        assert read_plain(plain, manner) == [None]


@pytest.mark.parametrize("bits", [8, 16])
def test_what_is_sure_is_what_unpack_finds(bits):
    rng, sure = np.random.default_rng(bits), 0
    top = 2**bits - 1
    for k in range(60):
        n = gradient_to_normals(slopes(14, 20, k) * rng.uniform(0, 6))[0].permute(1, 2, 0).numpy()
        n = n * rng.uniform(0.99, 1.01) + rng.normal(0, rng.uniform(0, 0.02), n.shape)
        codes = np.rint((np.clip(n, -1, 1) + 1) / 2 * top).astype(np.uint8 if bits == 8 else np.uint16)
        if k % 5 == 0:
            codes[: rng.integers(14)] = rng.choice([0, top // 2, top])
        if k % 7 == 0:
            codes[..., 2] = codes[..., 2] // 2 + top // 4 if k % 2 else top // 2 + 1
        normals, known = unpack_rgb(codes[None])
        if known[0]:
            sure += 1
            one = unpack(codes)
            assert one.packing == "rgb"
            np.testing.assert_array_equal(np.moveaxis(one.normals, -1, 0).astype(np.float32), normals[0])
    assert sure > 10


@pytest.mark.parametrize("own", NORMAL_CONVENTIONS)
def test_residuals_of_each_are_those_of_one(own):
    normals = torch.cat([gradient_to_normals(slopes(12, 15, k), own) for k in range(3)])
    mask = torch.rand(3, 1, 12, 15, generator=torch.Generator().manual_seed(0)) > 0.1
    same = [name for name in NORMAL_CONVENTIONS if NORMAL_CONVENTIONS[name][2] == NORMAL_CONVENTIONS[own][2]]
    found = convention_residuals(normals_to_gradient(normals, own, mask=mask), own, same)
    for k in range(3):
        parts = normals[k : k + 1], mask[k : k + 1]
        one = guess_convention(*parts, same).residual
        # each by its own slopes, with no word about frames
        terms = {}
        for name in same:
            field = normals_to_gradient(parts[0], name, mask=parts[1])
            whole = (field.mask[..., 1:, 1:] & field.mask[..., 1:, :-1] & field.mask[..., :-1, 1:]) & field.mask[
                ..., :-1, :-1
            ]
            gx, gy = field.gradient[:, :1], field.gradient[:, 1:]
            a = ((gy[..., 1:, :] + gy[..., :-1, :]) / 2).diff(dim=-1)[whole]
            b = ((gx[..., 1:] + gx[..., :-1]) / 2).diff(dim=-2)[whole]
            terms[name] = float((a - b).abs().sum()), float((a.abs() + b.abs()).sum())
        scale = max(both for _, both in terms.values())
        for name in same:
            assert one[name] == pytest.approx(terms[name][0] / scale, rel=1e-4)
            assert float(found[name][k]) == pytest.approx(one[name], rel=1e-5)
