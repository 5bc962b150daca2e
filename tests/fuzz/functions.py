"""How arguments of public functions are drawn, and the laws that their results keep."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import torchdls
from tests.fuzz.case import Flaw, close, same_bits
from tests.fuzz.integrators import KINDS
from torchdls import LEARNERS

F64 = torch.float64
Given = dict[str, Any]


class Draw:
    """Sizes, dtype and seeds of one case."""

    def __init__(self, rng: random.Random, least: int = 1) -> None:
        self.rng = rng
        side = lambda: max(least, rng.choice([1, 2, 3, 4, 5, 7, 8, 12, 17]))  # noqa: E731
        self.n, self.h, self.w = rng.choice([1, 1, 2, 3]), side(), side()
        self.dtype = rng.choice(["F32", "F64"])

    @property
    def seed(self) -> int:
        return self.rng.randrange(10**6)

    def tensor(self, c: int, kind: str | None = None, scale: float = 1.0) -> str:
        kind = kind or self.rng.choice(KINDS)
        shape = f"{self.n}, {c}, {self.h}, {self.w}"
        return f"field({shape}, kind={kind!r}, seed={self.seed}, scale={scale!r}, dtype={self.dtype})"

    def mask(self, n: int | None = None) -> str:
        kind = self.rng.choice(["full", "sieve", "islands", "corridors", "lone"])
        return f"mask({self.n if n is None else n}, {self.h}, {self.w}, {kind!r}, {self.seed})"

    def maybe(self, **given: str) -> dict[str, str]:
        return {name: code for name, code in given.items() if self.rng.random() < 0.5}

    def normals(self, scale: float = 1.0) -> str:
        return f"torchdls.gradient_to_normals({self.tensor(2, scale=scale)})"

    def steps(self) -> str:
        return self.rng.choice(["1.0", "0.25", "(0.5, 2.0)", "(1e-5, 1e-5)"])


def need(holds: bool, what: str) -> None:
    if not holds:
        raise Flaw(what)


# ---- geometry


def normals_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"normals": d.normals(), "convention": repr(rng.choice(["opengl", "directx", "opencv", "matlab"])),
            **d.maybe(mask=d.mask(), pixel_size=d.steps())}  # fmt: skip


def there_and_back(f: Any, given: Given, field: Any) -> None:
    need(bool((field.gradient[~field.mask.expand_as(field.gradient)] == 0).all()), "gradient at invalid pixels")
    rest = {k: given[k] for k in ("convention", "pixel_size") if k in given}
    normals = torchdls.gradient_to_normals(field.gradient, **rest)
    inside = field.mask.expand_as(normals)
    size = given["normals"].norm(dim=1, keepdim=True)
    difference = torch.where(inside, normals - given["normals"] / torch.where(size > 0, size, 1), 0).abs().max()
    need(float(difference) < 1e-4, f"there and back differs by {float(difference):.1e}")


def gradient_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    convention = repr(rng.choice(["opengl", "directx", "opencv", "kornia", "matlab"]))
    return {"gradient": d.tensor(2, scale=rng.choice([1.0, 1e-20, 1e6, 1e20])), "convention": convention}


def of_length_one(f: Any, given: Given, normals: Tensor) -> None:
    need(bool(((normals.norm(dim=1) - 1).abs() < 1e-5).all()), "normals are not of length 1")


CONVENTIONS = {"normals": (3, ["opengl", "directx", "opencv", "kornia", "matlab"]),
               "gradient": (2, ["image", "cartesian", "depth", "matlab"])}  # fmt: skip


def convert_case(kind: str) -> Callable[[random.Random], dict[str, str]]:
    c, names = CONVENTIONS[kind]
    return lambda rng: {kind: Draw(rng).tensor(c), "source": repr(rng.choice(names)), "target": repr(rng.choice(names))}


def converted_back(f: Any, given: Given, result: Tensor) -> None:
    again = f(result, given["target"], given["source"])
    need(same_bits(again, given["normals" if "normals" in given else "gradient"]), "there and back is not the same")


def guess_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 3)
    return {"normals": d.normals(), **d.maybe(mask=d.mask(1 if rng.random() < 0.5 else d.n))}


def points_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"height": d.tensor(1), "pixel_size": d.steps()}


def depth_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"depth": f"{d.tensor(1)}.exp()", "camera": "torch.tensor([[9.0, 0, 3], [0, 9, 2], [0, 0, 1]])"}


def log_depth_case(rng: random.Random) -> dict[str, str]:
    return {"log_depth": Draw(rng).tensor(1), "scale": rng.choice(["1.0", "2.5", "1e-3"])}


# ---- measures, noise


def pair_case(first: str, **more: str) -> Callable[[random.Random], dict[str, str]]:
    def draw(rng: random.Random) -> dict[str, str]:
        d = Draw(rng)
        exponential = ".exp()" if first == "depth" else ""
        one, other = (f"{d.tensor(1)}{exponential}" for _ in range(2))
        return {first: one, "reference": other, **more, **d.maybe(mask=d.mask())}

    return draw


def angular_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 3)
    return {"height": d.tensor(1), "reference": d.tensor(2), **d.maybe(pixel_size=d.steps())}


def ssim_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 12)
    return {"height": d.tensor(1), "reference": d.tensor(1), "data_range": rng.choice(["1.0", "30.0", "1e-9"])}


def free_of_constants(f: Any, given: Given, error: Tensor) -> None:
    need(bool((error >= 0).all()), "negative")
    again = f(**{**given, "height": given["height"] + 5.0})
    close(again, error, 1e-3, "a constant added", 1e-4)
    same = f(**{**given, "height": given["reference"]})
    need(bool((same.abs() < 1e-5).all()), "not 0 for the reference itself")


def free_of_scale(f: Any, given: Given, error: Tensor) -> None:
    close(f(**{**given, "depth": given["depth"] * 4.0}), error, 1e-3, "a depth times 4", 1e-5)


def like_itself(f: Any, given: Given, similarity: Tensor) -> None:
    need(bool((similarity <= 1 + 1e-5).all()), "above 1")
    same = f(**{**given, "height": given["reference"]})
    need(bool(((same - 1).abs() < 1e-5).all()), "not 1 for the reference itself")


def noise_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 2)
    return {"gradient": d.tensor(2, scale=rng.choice([1.0, 1e-20, 1e6])), **d.maybe(pixel_size=d.steps())}


def scales(f: Any, given: Given, sigma: Tensor) -> None:
    need(bool((sigma >= 0).all()), "negative")
    close(f(**{**given, "gradient": given["gradient"] * -8.0}), 8 * sigma, 1e-5, "slopes times -8")


def add_noise_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"gradient": d.tensor(2), "snr_db": repr(rng.choice([-20.0, 0.0, 15.0, 80.0])), **d.maybe(mask=d.mask())}


def sigma_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"gradient": d.tensor(2), "snr_db": "10.0", **d.maybe(mask=d.mask())}


# ---- operators


def image_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"x": d.tensor(rng.choice([1, 2]), scale=rng.choice([1.0, 1e15]))}


def inverse_of(other: str) -> Callable[[Any, Given, Tensor], None]:
    def law(f: Any, given: Given, y: Tensor) -> None:
        tol = 1e-12 if y.dtype == F64 else 1e-5
        close(getattr(torchdls, other)(y), given["x"], tol, "there and back", 0.0)
        need(abs(float(y.norm() / (given["x"].norm() + 1e-30)) - 1) < 1e-4 or not float(y.norm()), "norm not kept")

    return law


def edges_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    seed, c = d.seed, rng.choice([1, 2])
    weight = f"trust({d.n}, {c}, {d.h}, {d.w}, kind='orders', seed={seed}, dtype={d.dtype})"
    return {"gradient": d.tensor(2), **d.maybe(mask=d.mask(), weight=weight)}


def linear_in_slopes(f: Any, given: Given, result: tuple[Tensor, Tensor | None]) -> None:
    v, _ = f(**{**given, "gradient": given["gradient"] * -4.0})
    need(same_bits(v, result[0] * -4.0), "not linear in the slopes")
    need(result[1] is None or bool((result[1] >= 0).all()), "negative trust")


def operator_case(rng: random.Random) -> dict[str, str]:
    stencil = rng.choice(["forward", "backward", "central"])
    return {"stencil": repr(stencil), "pixel_size": rng.choice(["(1.0, 1.0)", "(0.5, 2.0)"])}


def adjoint(f: Any, given: Given, operator: Any) -> None:
    x, y = torch.randn(2, 1, 5, 7, dtype=F64), torch.randn(2, 2, 5, 7, dtype=F64)
    left, right = float((operator(x) * y).sum()), float((x * operator.adjoint(y)).sum())
    need(abs(left - right) < 1e-9 * (1 + abs(left)), "the adjoint is not")


def patches_case(rng: random.Random) -> dict[str, str]:
    return {"size": repr(rng.choice([2, 3, (2, 4), 8])), "stride": repr(rng.choice([1, 2, (1, 2)]))}


def patches_adjoint(f: Any, given: Given, patches: Any) -> None:
    x = torch.randn(2, 1, 9, 11, dtype=F64)
    cut = patches.extract(x)
    y = torch.randn_like(cut)
    left, right = float((cut * y).sum()), float((x * patches.adjoint(y, (9, 11))).sum())
    need(abs(left - right) < 1e-9 * (1 + abs(left)), "the adjoint is not")


# ---- photometric


def photometric_case(rng: random.Random) -> dict[str, str]:
    d, k = Draw(rng), rng.choice([3, 4, 9])
    lights = f"torchdls.ring_of_lights({k}, dtype={d.dtype})"
    images = rng.choice([
        f"torchdls.render({d.normals()}, {lights}, highlight={rng.choice([0.0, 0.5])})",
        f"{d.tensor(k)}.abs()",
        f"{d.tensor(k, scale=1e-12)}.abs()",
    ])  # fmt: skip
    lit = f"(field({d.n}, {k}, {d.h}, {d.w}, seed={d.seed}) > -0.5)"
    return {"images": images, "lights": lights, **d.maybe(mask=d.mask(), lit=lit)}


def brighter(f: Any, given: Given, result: Any) -> None:
    """Twice as bright: the same normals, twice the albedo."""
    length = result.normals.norm(dim=1)
    need(bool(((length < 1e-6) | ((length - 1).abs() < 1e-4)).all()), "normals neither 0 nor of length 1")
    need(bool((result.confidence >= 0).all()) and bool((result.albedo >= 0).all()), "negative confidence or albedo")
    again = f(**{**given, "images": given["images"] * 2.0})
    close(again.normals, result.normals, 1e-3, "normals of images times 2")
    close(again.albedo / 2, result.albedo, 1e-3, "albedo of images times 2")


def render_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"normals": d.normals(), "lights": f"torchdls.ring_of_lights({rng.choice([3, 5])})",
            **d.maybe(albedo=f"{d.tensor(1)}.abs()", highlight="0.4", snr_db="20.0")}  # fmt: skip


def shadow_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    return {"height": d.tensor(1), "lights": f"torchdls.ring_of_lights(3, {rng.choice([5.0, 45.0, 89.0])})"}


def is_bool(f: Any, given: Given, shadow: Tensor) -> None:
    need(shadow.dtype == torch.bool, "not bool")


# ---- dictionaries


def sweep_case(rng: random.Random) -> dict[str, str]:
    n, K, L, N = rng.choice([1, 4, 9]), rng.choice([1, 4, 12]), rng.choice([1, 3, 20]), rng.choice([1, 2])
    dtype, s = rng.choice(["F32", "F64"]), [rng.randrange(10**6) for _ in range(3)]
    kind = rng.choice(KINDS)
    return {"P": f"field({N}, {n}, {L}, kind={kind!r}, seed={s[0]}, dtype={dtype})",
            "D": f"dictionary({rng.choice([1, N])}, {n}, {K}, seed={s[1]}, dtype={dtype})",
            "mu": rng.choice(["0.0", "0.3", "2.0", "1e9"])}  # fmt: skip


def soup_case(rng: random.Random) -> dict[str, str]:
    given = sweep_case(rng)
    given["B"] = (
        f"torch.zeros({given['P']}.shape[0], {given['D']}.shape[2], {given['P']}.shape[2], dtype={given['P']}.dtype)"
    )
    given["order"] = repr(rng.choice(["atom", "block"]))
    given["threshold"] = repr(rng.choice(["hard", "hard", "soft", "firm"]))
    return given


def learner_case(rng: random.Random) -> tuple[str, dict[str, str]]:
    """Unitary needs square dictionaries, DinoKat square patches."""
    name, dtype = rng.choice(list(LEARNERS)), rng.choice(["F32", "F64"])
    n, L, N = rng.choice([1, 4, 9]), rng.choice([1, 3, 20]), rng.choice([1, 2])
    K, shared, kind = n if name == "unitary" else rng.choice([1, 4, 12]), rng.choice([1, N]), rng.choice(KINDS)
    s = [rng.randrange(10**6) for _ in range(2)]
    P, D = (f"field({N}, {n}, {L}, kind={kind!r}, seed={s[0]}, dtype={dtype})",
            f"dictionary({shared}, {n}, {K}, seed={s[1]}, dtype={dtype})")  # fmt: skip
    if name == "unitary":
        D = f"torch.linalg.qr({D})[0]"
    if name == "dino_kat":  # atoms of rank 1
        K, D = n, f"torchdls.dct_dictionary({round(n**0.5)}, dtype={dtype})[None]"
    given = {"R": P, "D": D, "B": f"torch.zeros({N}, {K}, {L}, dtype={dtype})"}
    return f"lambda R, D, B, mu: torchdls.LEARNERS[{name!r}]()(R.clone(), D, B.clone(), mu)", {
        **given,
        "mu": rng.choice(["0.0", "0.3", "2.0", "1e9"]),
    }


def cost(P: Tensor, D: Tensor, B: Tensor, mu: float) -> Tensor:
    return (P - D @ B).square().sum((1, 2)) + mu**2 * (B != 0).sum((1, 2))


def no_dearer(P: Tensor, D0: Tensor, D: Tensor, B: Tensor, mu: float) -> None:
    need(bool(((D.norm(dim=1) - 1).abs() < 1e-4).all()), "atoms are not of length 1")
    if D0.shape[0] == P.shape[0] or D.shape[0] == P.shape[0]:
        before, after = P.square().sum((1, 2)), cost(P, D, B, mu)
    else:
        before, after = P.square().sum(), cost(P, D, B, mu).sum()
    need(bool((after <= before * (1 + 1e-4) + 1e-12).all()), "the cost rose")


def learned(f: Any, given: Given, result: Any) -> None:
    R, D, B = result
    close(given["R"] - D @ B, R, 1e-3, "residual", 1e-4)
    no_dearer(given["R"], given["D"], D, B, given["mu"])


def swept(f: Any, given: Given, result: Any) -> None:
    if given["threshold"] == "hard":
        D, B = result
        no_dearer(given["P"], given["D"], D, B, given["mu"])


def pursuit_case(rng: random.Random) -> dict[str, str]:
    given = sweep_case(rng)
    if rng.random() < 0.5:
        given["n_nonzero"] = rng.choice(["1", "2", "5"])
    if rng.random() < 0.3:  # atoms that are nearly the same
        given["D"] = f"torch.cat([{given['D']}, {given['D']} * (1 + 1e-6)], -1)"
    return given


def pursued(f: Any, given: Given, B: Tensor) -> None:
    P = given["P"]
    left = (P - given["D"] @ B).norm(dim=1)
    need(bool((left <= P.norm(dim=1) * (1 + 1e-4)).all()), "residuals above the patches")


def cosines_case(rng: random.Random) -> dict[str, str]:
    return {"patch_size": repr(rng.choice([1, 3, 8, (2, 5)])), "dtype": rng.choice(["F32", "F64"])}


def unit_atoms(f: Any, given: Given, D: Tensor) -> None:
    need(bool(((D.norm(dim=0) - 1).abs() < 1e-5).all()), "atoms are not of length 1")


def objective_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 4)
    n, L = 16, f"torchdls.Patches(4, 2).extract({d.tensor(1)}).shape[-1]"
    codes = f"field({d.n}, 16, {L}, seed={d.seed}, dtype={d.dtype})"
    return {"height": d.tensor(1), "gradient": d.tensor(2), "codes": codes, "lam": "0.5", "mu": "0.2",
            "dictionary": f"dictionary({d.n}, {n}, 16, seed={d.seed}, dtype={d.dtype})",
            "patches": "torchdls.Patches(4, 2)"}  # fmt: skip


# ---- surfaces, pictures, choice


def surface_case(rng: random.Random) -> dict[str, str]:
    return {"name": repr(rng.choice(list(torchdls.SURFACES))), "n": repr(rng.choice([2, 5, 16, (4, 9)]))}


def shade_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 2)
    return {"height": d.tensor(1, scale=rng.choice([1.0, 1e15])), **d.maybe(azimuth="10.0", altitude="80.0")}


def between_0_and_1(f: Any, given: Given, shade: Tensor) -> None:
    need(bool(((shade >= 0) & (shade <= 1 + 1e-6)).all()), "not within 0 and 1")


def pages_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 3)
    d.n = 1
    return {"heights": f"{{'one': {d.tensor(1)}, 'other': {d.tensor(1)}}}", **d.maybe(mask=d.mask())}


def compare_case(rng: random.Random) -> dict[str, str]:
    return {"truth": "None", **pages_case(rng)}


def preview_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 3)
    d.n = 1
    return {
        "height": d.tensor(1),
        **d.maybe(
            gradient=d.tensor(2),
            truth=d.tensor(1),
            trust=f"{d.tensor(1)}.abs()",
            jump=f"{d.tensor(2)}.abs()",
            mask=d.mask(),
        ),
    }


def select_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 12)
    one = "lambda g: torchdls.FrankotChellappa()(g)"
    return {"integrate": one, "gradient": d.tensor(2, "waves"), "candidates": "1"}
