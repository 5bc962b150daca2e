"""Cases of the integrators of the registry, and of `solve`."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, Literal, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

import torchdls
from tests.fuzz.case import Case, Flaw, check_finite, close, same_bits
from tests.fuzz.values import rational_solve, view
from tests.helpers.methods import METHODS, Method, method
from torchdls import INTEGRATORS, edge_slopes

F64 = torch.float64
KINDS = ["noise", "noise", "waves", "jump", "spike", "constant", "zero"]
MASKS = ["full", "sieve", "islands", "corridors", "lone"]
VIEWS = ["strided", "turned", "negative", "expanded"]
WRONG_TENSORS = ["None", "[1.0]", "'x'", "{}.numpy()", "{}.half()", "{}.long()", "{}[..., :0]", "{}[..., 1:]",
                 "{}[0, 0]", "torch.stack([{}, {}])", "{}.to('meta')"]  # fmt: skip
# What METHODS promises on the images of its tests alone.
NO = {
    # Of edges that are equal, as those along a straight jump or wave, the trees and the release take the first.
    "alpha_surface": ["follows_flips", "follows_a_transpose"],
    "partial_integrability": ["follows_flips", "follows_a_transpose"],
    "spectral_path": ["follows_flips", "follows_a_transpose"],
    "dls": ["follows_flips"],  # the grid of its patches shifts where the stride does not fit the image
    "slope_dls": ["carries_offsets"],  # its patches span the gaps between the components of a mask
}
# Sweeps that a limit may end long before they are through: relations hold where they say that they are.
PATIENT = {"horn_brooks"}
# What a call cannot hold, even where numbers are fine; None stands for an argument that is not given.
REFUSED = {"None", "[1.0]", "'x'", "{}.numpy()", "{}.half()", "{}.long()"}


def shape_of(rng: random.Random, least: int = 1) -> tuple[int, int, int]:
    """N, H, W: mostly tiny, sometimes a line."""
    side = lambda: max(least, rng.choice([1, 2, 3, 4, 5, 6, 7, 8, 11, 13]))  # noqa: E731
    return rng.choice([1, 1, 2, 3]), side(), side()


def field_code(rng: random.Random, n: int, c: int, h: int, w: int, scale: float, dtype: str) -> str:
    kind, seed = rng.choice(KINDS), rng.randrange(10**6)
    return f"field({n}, {c}, {h}, {w}, kind={kind!r}, seed={seed}, scale={scale!r}, dtype={dtype})"


def optional(rng: random.Random, accepts: frozenset[str], shape: tuple[int, int, int], dtype: str, tame: bool) -> Any:
    """Expressions of mask, weight and anchors that a method takes, some of the time."""
    n, h, w = shape
    given: dict[str, str] = {}
    inside = f"mask({n}, {h}, {w}, kind='full')"
    if "mask" in accepts and rng.random() < 0.5:
        inside = f"mask({n}, {h}, {w}, kind={rng.choice(MASKS)!r}, seed={rng.randrange(10**6)})"
        given["mask"] = inside
    if "weight" in accepts and rng.random() < 0.4:
        kind = rng.choice(["even", "mild", "holes"] if tame else ["even", "mild", "holes", "orders"])
        scale = 1.0 if tame else rng.choice([1.0, 1.0, 1e-9, 1e12, 1e-24])
        c, seed = rng.choice([1, 2]), rng.randrange(10**6)
        given["weight"] = f"trust({n}, {c}, {h}, {w}, kind={kind!r}, seed={seed}, scale={scale!r}, dtype={dtype})"
    if "anchor" in accepts and rng.random() < 0.4:
        offset = rng.choice([0.0, 1.0, 1e3] if tame else [0.0, 500.0, 1e6])
        weight = 10.0 ** rng.choice([0, 3, 6] if tame else range(-9, 13))
        seed, kind = rng.randrange(10**6), rng.choice(["one", "some", "column", "all"])
        given["anchor"] = f"({field_code(rng, n, 1, h, w, 1.0, dtype)} + {offset!r})"
        given["anchor_weight"] = f"firm({inside}, {kind!r}, {seed}, {weight!r}, {dtype})"
    return given


def options_code(options: dict[str, Any]) -> str:
    def shown(value: Any) -> str:
        if isinstance(value, torchdls.Integrator):
            return f"torchdls.build({INTEGRATORS.name_of(type(value))!r}, **{value.options()!r})"
        return repr(value) if "=" not in repr(value) else f"torchdls.{value!r}"

    return "".join(f", {name}={shown(value)}" for name, value in options.items())


def build_code(name: str, options: dict[str, Any], **more: Any) -> str:
    return f"torchdls.INTEGRATORS[{name!r}](**dict({options_code({**options, **more}).lstrip(', ')}))"


def call(rng: random.Random) -> Case:
    """A call in order, and one relation that its result must keep."""
    name = rng.choice(list(INTEGRATORS))
    known = method(name)
    label = rng.choice([k for k, relation in RELATIONS.items() if not relation[1] & {*known.no, *NO.get(name, ())}])
    judge, _, exact, tame = RELATIONS[label]
    options = dict(next(iter(known.exact.values())) if exact else known.options)
    if rng.random() < 0.3:
        options["pixel_size"] = rng.choice([0.25, 3.0, (0.5, 2.0), (1e-5, 1e-5), (1.0, 30.0)])
    least = max(known.smallest, max([options.get("patch_size", 1), *options.get("patch_sizes", ())]))
    shape = shape_of(rng, least)
    dtype = "F64" if exact else rng.choice(["F32", "F64"])
    scale = rng.choice([1.0, 1.0, 30.0] if tame else [1.0, 1e-3, 1e3, 1e-20, 1e20])
    given = {"gradient": field_code(rng, shape[0], 2, *shape[1:], scale, dtype)}
    given |= optional(rng, INTEGRATORS[name].accepts, shape, dtype, tame)
    patient = name in PATIENT
    return Case(build_code(name, options), given, judge=judge, label=label, wild=scale > 1e15, patient=patient)


def anchored(rng: random.Random) -> Case:
    """Anchors of any weight, 1e6 away."""
    name = rng.choice([name for name in INTEGRATORS if "anchor" in INTEGRATORS[name].accepts])
    known, dtype = method(name), rng.choice(["F32", "F64"])
    shape = shape_of(rng, max(known.smallest, 2))
    offset, weight = rng.choice([0.0, 500.0, -1e6]), 10.0 ** rng.choice(range(-9, 13))
    inside = f"mask({shape[0]}, {shape[1]}, {shape[2]}, kind='full')"
    given = {
        "gradient": field_code(rng, shape[0], 2, *shape[1:], 1.0, dtype),
        "anchor": f"({field_code(rng, shape[0], 1, *shape[1:], 1.0, dtype)} + {offset!r})",
        "anchor_weight": f"firm({inside}, {rng.choice(['one', 'some'])!r}, {rng.randrange(999)}, {weight!r}, {dtype})",
    }
    made = build_code(name, dict(known.options))
    return Case(made, given, judge=anchors, label="anchors", patient=name in PATIENT)


def wrong(rng: random.Random) -> Case:
    """A call with one argument of another type, shape, channels, dtype or device."""
    case = call(rng)
    case.judge, case.label, name = None, "", rng.choice(list(case.arguments))
    wrongs = [w for w in WRONG_TENSORS if w not in ("None", "{}.to('meta')") or name == "gradient"]
    if name in ("anchor", "anchor_weight") or (name == "gradient" and rng.random() < 0.5):
        wrongs += ["{} * nan", "{} * inf"]
    if name.endswith("weight"):
        wrongs += ["{} * 0 - 1"]
    if name == "gradient":
        wrongs.remove("{}.to('meta')")
    form = rng.choice(wrongs)
    if form == "{}.half()" and name == "mask":
        form = "{}.int()"
    case.arguments[name] = form.replace("{}", case.arguments[name])
    case.spoilt, case.must_raise = name, form in REFUSED
    return case


def options(rng: random.Random) -> Case:
    """One option of the constructor set to anything: it says which it refuses, or the call works."""
    name = rng.choice(list(INTEGRATORS))
    known, kind = method(name), INTEGRATORS[name]
    parameters = INTEGRATORS.parameters(name)
    option = rng.choice(list(parameters))
    default = parameters[option]
    choices: list[Any] = [0, -1, 1, 2, 3, 0.0, 0.5, 1e-30, 1e30, float("inf"), float("nan"), "x", None, True, (2, 3)]
    hint = get_type_hints(kind.__init__).get(option)
    for part in (hint, *get_args(hint)):
        choices += list(get_args(part)) * 3 if get_origin(part) is Literal else []
    if default is not None and not isinstance(default, str):
        choices += [default] * 3
    value = rng.choice([c for c in choices if not isinstance(c, type)])
    most = 1000 if isinstance(value, int | float) and value == value and abs(value) < 1e9 else 1
    if option in ("n_iter", "max_iter") and isinstance(value, int | float) and value > most:
        value = 3
    text = options_code({**known.options, option: value}).replace("=inf", "=float('inf')")
    h, w = rng.choice([(8, 8), (9, 12)])
    given = {"gradient": field_code(rng, 1, 2, h, w, 1.0, rng.choice(["F32", "F64"]))}
    target = f"torchdls.INTEGRATORS[{name!r}](**dict({text.lstrip(', ')}))"
    return Case(target, given, spoilt=option, options=tuple(parameters), label="errors")


# ---- relations: (case, integrator, arguments, height)


def form(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    g, inside = given["gradient"], given.get("mask")
    if z.shape != (g.shape[0], 1, *g.shape[2:]) or z.dtype != g.dtype or z.device != g.device:
        raise Flaw(f"gave {z.dtype} {tuple(z.shape)} for gradient {g.dtype} {tuple(g.shape)}")
    if inside is not None and bool((z[~inside.expand_as(z)] != 0).any()):
        raise Flaw("not 0 outside the mask")


def twice(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    form(case, f, given, z)
    if not same_bits(f(**given), z):
        raise Flaw("the same call again gives other bits")


def told(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    result = f.solve(**given)
    check_finite([result.height])
    close(result.height, z, 1e-12, "height of solve")
    if result.iterations.shape != z.shape[:1] or result.converged.dtype != torch.bool:
        raise Flaw("iterations or converged of solve have another shape or dtype")


def batch(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    known = method(INTEGRATORS.name_of(type(f)) or "")
    tol = 10 * known.tol if z.dtype == F64 else max(10 * known.tol, 1e-3)
    alone = torch.cat([f(**{k: t[i : i + 1] for k, t in given.items()}) for i in range(len(z))])
    close(z, alone, tol, "each surface alone")
    close(f(**{k: t[0] for k, t in given.items()}), alone[0], tol, "a single field")


def views(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    rng = random.Random(str(case))
    changed = {k: view(t, rng.choice(VIEWS)) if t.is_floating_point() else view(t, "turned") for k, t in given.items()}
    tol = method(INTEGRATORS.name_of(type(f)) or "").tol
    close(f(**changed), f(**{k: t.clone() for k, t in changed.items()}), max(tol, 1e-6), "views")


def outside(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    inside = given.get("mask")
    form(case, f, given, z)
    if inside is None:
        return
    nan = {k: t if k == "mask" else torch.where(inside, t, torch.nan) for k, t in given.items()}
    close(f(**nan), z, 1e-9, "NaN outside the mask")


def scaled(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    if not bool(
        given["gradient"].flatten(1).any(1).all()
    ):  # a field of zeros, whose scale is 1 by convention, whatever the anchors are
        return
    for factor in (-1.0, 2.0**20):
        changed = {k: t * factor if k in ("gradient", "anchor") else t for k, t in given.items()}
        close(f(**changed) / factor, z, 1e-6, f"slopes times {factor:g}")


def flipped(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    """Weights of pixels move with them."""
    for dim, sign in ((-1, (-1.0, 1.0)), (-2, (1.0, -1.0))):
        changed = {k: t.flip(dim) for k, t in given.items()}
        changed["gradient"] = changed["gradient"] * torch.tensor(sign, dtype=z.dtype).view(1, 2, 1, 1)
        close(f(**changed).flip(dim), z, 1e-5, f"flipped along {dim}", 1e-12 * float(given["gradient"].abs().max()))


def transposed(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    changed = {k: t.mT for k, t in given.items()}
    for k in ("gradient", "weight"):
        if k in changed:
            changed[k] = changed[k].flip(1)
    size = f.pixel_size
    f.pixel_size = size[::-1]
    height = f(**changed).mT
    f.pixel_size = size
    close(height, z, 1e-5, "transposed", 1e-12 * float(given["gradient"].abs().max()))


def units(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    size = f.pixel_size
    for unit in (2.0**-10, 8.0):
        f.pixel_size = (size[0] * unit, size[1] * unit)
        changed = dict(given)
        if "anchor" in given:
            changed |= {"anchor": given["anchor"] * unit, "anchor_weight": given["anchor_weight"] / unit**2}
        height = f(**changed) / unit
        f.pixel_size = size
        close(height, z, 1e-7, f"pixels times {unit:g}")


def lifted(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    """All anchors 1000 higher: so is every component that one of them holds."""
    if "anchor" not in given or type(f).__name__ == "DLS":  # its patches hold the heights too
        return
    r = given["anchor_weight"]
    v, w = edge_slopes(given["gradient"], given.get("mask"), given.get("weight"))
    w = torch.ones_like(v) if w is None else w
    held = (
        torchdls.solve(torch.zeros_like(v), (w > 0).to(v.dtype), (r > 0).to(v.dtype), (r > 0).to(v.dtype)).height > 0.5
    )
    close(f(**{**given, "anchor": given["anchor"] + 1000.0}), z + 1000.0 * held, 1e-6, "anchors 1000 higher", 1e-6)


def anchors(case: Case, f: Any, given: dict[str, Any], z: Tensor) -> None:
    """Met: where there is one, or where they are firm."""
    anchor, r = given["anchor"], given["anchor_weight"]
    known = r > 0
    one = known.sum((1, 2, 3)) == 1
    if type(f).__name__ == "DLS" and float(r.max()) < 1e6:
        return
    if not bool(one.all()) and float(r.max()) < 1e6:
        return
    relief = (torch.where(known, z - anchor, 0).abs()).amax((1, 2, 3))
    size = torch.stack([z.amax((1, 2, 3)) - z.amin((1, 2, 3)), torch.ones_like(relief)]).amax(0)
    allowed = 1e-4 * size + 8 * torch.finfo(z.dtype).eps * anchor.abs().amax((1, 2, 3))
    if not bool((relief <= allowed).all()):
        raise Flaw(f"anchors missed by {float((relief / size).max()):.1e} of the relief")


# label -> (relation, promises that it needs, whether on forms without early stops in float64, whether tame input)
RELATIONS: dict[str, tuple[Callable[..., None], set[str], bool, bool]] = {
    "form, twice": (twice, set(), False, False),
    "told": (told, set(), False, False),
    "batch": (batch, set(), False, True),
    "views": (views, set(), False, True),
    "outside": (outside, set(), False, True),
    "scaled": (scaled, {"scales_with_the_slopes"}, True, True),
    "flipped": (flipped, {"follows_flips"}, True, True),
    "transposed": (transposed, {"follows_a_transpose"}, True, True),
    "units": (units, set(), True, True),
    "lifted": (lifted, {"carries_offsets"}, True, True),
}


# ---- solve


def solve(rng: random.Random) -> Case:
    """Small systems with weights over 21 orders, against rational numbers."""
    n, h, w = 1, *rng.choice([(2, 2), (3, 3), (3, 4), (1, 5), (4, 2), (2, 5), (4, 4), (5, 1)])
    dtype, kind = rng.choice(["F32", "F64"]), rng.choice(["even", "mild", "holes", "orders", "orders"])
    scale = rng.choice([1.0, 1.0, 1e-3, 1e3])
    given = {"v": field_code(rng, n, 2, h, w, scale, dtype)}
    seed = rng.randrange(10**6)
    given["w"] = f"trust({n}, 2, {h}, {w}, kind={kind!r}, seed={seed}, dtype={dtype}) * mask({n}, {h}, {w}, 'full')"
    if rng.random() < 0.6:
        where, weight = rng.choice(["one", "some", "column", "all"]), 10.0 ** rng.randrange(-9, 13)
        offset = rng.choice([0.0, 500.0, 1e6])
        given["anchor"] = f"({field_code(rng, n, 1, h, w, scale, dtype)} + {offset!r})"
        given["anchor_weight"] = f"firm(mask({n}, {h}, {w}), {where!r}, {rng.randrange(999)}, {weight!r}, {dtype})"
    return Case("torchdls.solve", given, judge=truth, label="truth")


def truth(case: Case, f: Any, given: dict[str, Any], result: Any) -> None:
    v, w, anchor, r = (given.get(k) for k in ("v", "w", "anchor", "anchor_weight"))
    if anchor is not None and not bool((r > 0).any()):
        anchor = None
    present = torch.ones_like(v)
    present[:, 0, :, -1] = present[:, 1, -1] = 0  # edges that leave the rectangle
    expected = rational_solve(
        v[0], (w * present)[0], None if anchor is None else anchor[0], None if r is None else r[0]
    )
    offset = 0.0 if anchor is None else float(anchor.abs().max())
    relief = float(expected.max() - expected.min()) + float(v.abs().max())
    error = float((result.height[0].double() - expected).abs().max())
    size = max(offset, float(expected.abs().max()))
    allowed = 1e-5 * relief + 8 * torch.finfo(v.dtype).eps * size
    if not bool(result.converged.all()):
        raise Flaw("not converged")
    if error > allowed:
        raise Flaw(f"off the exact solution by {error / relief:.1e} of the relief")


MAKERS: list[tuple[Callable[[random.Random], Case], int]] = [
    (call, 30), (anchored, 8), (wrong, 12), (options, 12), (solve, 12)
]  # fmt: skip
assert set(METHODS) <= set(INTEGRATORS)
assert isinstance(method("least_squares"), Method)
