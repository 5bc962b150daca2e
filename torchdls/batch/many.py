"""Many fields of many sizes through one integrator: equal sizes together, nothing padded, one result for each."""

from __future__ import annotations

import time
import warnings
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchdls.batch.lots import in_lots, same_bits
from torchdls.integrators import Integrator
from torchdls.solvers import ConvergenceWarning

_NAMES = ("gradient", "mask", "weight")


class Integrated(NamedTuple):
    """One result of `integrate_many`.

    Attributes:
        number: which surface of the dataset it is, counted from 0.
        height: (1, H, W), or None if it failed.
        noise: the standard deviation of one gradient sample that the method found, or None.
        iterations: how many the surface took, or None where the method does not tell.
        converged: whether it met the method's tolerance, or None likewise.
        seconds: the time of its lot, divided by the surfaces in it.
        together: how many surfaces were in its lot.
        error: why it failed, or None.

    Example:
        >>> next(torchdls.integrate_many([torch.ones(2, 8, 8)], torchdls.LeastSquares())).together
        1
    """

    number: int
    height: Tensor | None
    noise: float | None = None
    iterations: int | None = None
    converged: bool | None = None
    seconds: float = 0.0
    together: int = 1
    error: str | None = None


class Member(NamedTuple):
    """A surface in a lot: its key, and fields (1, C, H, W)."""

    key: int
    gradient: Tensor
    mask: Tensor | None
    weight: Tensor | None


def integrate_many(
    dataset: Iterable[Any],
    integrator: Integrator,
    *,
    memory: int = 2**30,
    exact: bool = True,
    errors: Literal["raise", "return"] = "raise",
) -> Iterator[Integrated]:
    r"""Integrate the fields of a dataset, small ones of equal size together; the results do not depend on which.

    Nothing is padded. With `exact` only those surfaces share a batch whose bits stay the same in it: full
    rectangles of 16, 32, 48 or 64 pixels a side without weights, by least squares (tried anew on the first lot of each
    size). All others go alone. Without it all of equal size share one, as is fast on a
    GPU; results then differ by rounding.

    Args:
        dataset: yields gradients (2, H, W) or batches (N, 2, H, W), tuples (gradient, mask, weight) of which the last
            may be missing or None, or mappings with these names; such as a `DataLoader` with `batch_size=None`.
        integrator: any; it is called without recording derivatives.
        memory: bytes that the surfaces which wait for others of their size, and one lot, may take; a surface that is
            larger goes alone.
        exact: see above.
        errors: "raise" the error of a surface, or "return" it in its result and go on.

    Yields:
        `Integrated` for each surface, in the order in which their lots fill up.

    Raises:
        TypeError: an item is none of these.
        ValueError: `memory` is not positive, `errors` is unknown, or, with "raise", a surface cannot be integrated.

    Example:
        >>> slopes = [torch.ones(2, n, n) for n in (16, 9, 16)]
        >>> for result in torchdls.integrate_many(slopes, torchdls.LeastSquares()):
        ...     print(result.number, result.height.shape, result.together)
        1 torch.Size([1, 9, 9]) 1
        0 torch.Size([1, 16, 16]) 2
        2 torch.Size([1, 16, 16]) 2
    """
    if errors not in ("raise", "return"):
        raise ValueError(f"integrate_many: errors={errors!r} is unknown; choose from 'raise', 'return'")
    if not memory > 0:
        raise ValueError(f"integrate_many: memory={memory!r} given, a positive number of bytes is needed")
    return _results(dataset, integrator, memory, exact, errors)


def _results(
    dataset: Iterable[Any], integrator: Integrator, memory: int, exact: bool, errors: str
) -> Iterator[Integrated]:
    trusted: Trusted = {} if exact else AlwaysTrusted()

    def kind(member: Member) -> Hashable | None:
        return lot_key(member, integrator, exact)

    for lot in in_lots(
        _members(dataset), kind, lambda member: member.gradient.shape[-2] * member.gradient.shape[-1], memory, exact
    ):
        for result, error in together(lot, integrator, kind(lot[0]), trusted):
            if error is not None and errors == "raise":
                raise error
            yield result


def lot_key(member: Member, integrator: Integrator, exact: bool = True) -> Hashable | None:
    """What surfaces of one lot have in common, or None for one that goes alone."""
    g = member.gradient
    if exact and not (member.mask is None and member.weight is None and same_bits(integrator, g.shape[-2:])):
        return None
    return (
        *g.shape[-2:],
        g.dtype,
        g.device,
        member.mask is None,
        None if member.weight is None else len(member.weight[0]),
    )


# Kinds of lots whose first one had the same bits as its surfaces alone, or had not.
Trusted = dict[Hashable, bool]


class AlwaysTrusted(Trusted):
    """Where rounding may differ there is nothing to try."""

    def __contains__(self, kind: object) -> bool:
        return True

    def __getitem__(self, kind: Hashable) -> bool:
        return True


def together(
    lot: Sequence[Member], integrator: Integrator, kind: Hashable, trusted: Trusted
) -> list[tuple[Integrated, Exception | None]]:
    """The results of a lot as a batch, if on this machine it has the bits of its surfaces alone, else one by one.

    The first lot of a kind tries it, on up to four of its surfaces, and notes what it found in `trusted`.
    """
    if len(lot) == 1 or (kind in trusted and not trusted[kind]):
        return [result for member in lot for result in integrate_lot([member], integrator)]
    found = integrate_lot(lot, integrator)
    if kind not in trusted:
        some = range(0, len(lot), -(-len(lot) // 4))
        alone = {k: integrate_lot([lot[k]], integrator)[0][0].height for k in some}
        trusted[kind] = all(_equal(height, found[k][0].height) for k, height in alone.items())
        if not trusted[kind]:
            return together(lot, integrator, kind, trusted)
    return found


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b if a is None or b is None else torch.equal(a, b)


def integrate_lot(lot: Sequence[Member], integrator: Integrator) -> list[tuple[Integrated, Exception | None]]:
    """The results of a lot; if it fails as a whole each surface by itself, so that the others do not suffer."""
    start = time.perf_counter()
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # each result says whether it converged
            found = integrator.solve(
                torch.cat([member.gradient for member in lot]),
                _stacked([member.mask for member in lot]),
                _stacked([member.weight for member in lot]),
            )
    except (ValueError, TypeError, RuntimeError, MemoryError) as error:
        if len(lot) > 1:
            return [result for member in lot for result in integrate_lot([member], integrator)]
        return [(Integrated(lot[0].key, None, error=" ".join(str(error).split()) or type(error).__name__), error)]
    seconds = (time.perf_counter() - start) / len(lot)
    parts = zip(lot, found.height.unbind(), _told(found._asdict(), len(lot)), strict=True)
    results = [Integrated(member.key, height, *told, seconds, len(lot)) for member, height, told in parts]
    return [(result, None) for result in results]


def _stacked(parts: list[Tensor | None]) -> Tensor | None:
    first = parts[0]
    if first is None:
        return None
    return first if len(parts) == 1 else torch.cat([part for part in parts if part is not None])


def _told(found: Mapping[str, Any], n: int) -> list[tuple[float | None, int | None, bool | None]]:
    """Noise, iterations and convergence of each surface, as far as the method tells them."""
    noise, iterations, converged = (_listed(found.get(name), n) for name in ("noise", "iterations", "converged"))
    if "iterations" not in found and "misfit" in found:
        iterations = [found["misfit"].shape[1] - 1] * n
    return list(zip(noise, iterations, converged, strict=True))


def _listed(values: Tensor | None, n: int) -> list[Any]:
    return [None] * n if values is None else values.tolist()


def _members(dataset: Iterable[Any]) -> Iterator[Member]:
    count = 0
    for item in dataset:
        gradient, mask, weight = _fields(item)
        if not isinstance(gradient, Tensor) or gradient.ndim not in (3, 4):
            given = tuple(gradient.shape) if isinstance(gradient, Tensor) else type(gradient).__name__
            raise TypeError(f"integrate_many: gradient {given} given, a tensor (2, H, W) or (N, 2, H, W) is needed")
        n = len(gradient) if gradient.ndim == 4 else 1
        for k in range(n):
            yield Member(count + k, *(_single(field, k) for field in (gradient, mask, weight)))  # type: ignore[arg-type]
        count += n


def _fields(item: Any) -> tuple[Any, Any, Any]:
    if isinstance(item, Mapping):
        if "gradient" not in item or set(item) - set(_NAMES):
            raise TypeError(f"integrate_many: an item holds {', '.join(map(str, item))}; {', '.join(_NAMES)} are known")
        return item["gradient"], item.get("mask"), item.get("weight")
    if isinstance(item, tuple | list):
        if not 1 <= len(item) <= 3:
            raise TypeError(f"integrate_many: an item of {len(item)} parts given, (gradient, mask, weight) is needed")
        gradient, mask, weight = (*item, None, None)[:3]
        return gradient, mask, weight
    return item, None, None


def _single(field: Tensor | None, k: int) -> Tensor | None:
    if field is None or field.ndim == 3:
        return None if field is None else field[None]
    return field[k : k + 1] if len(field) > 1 else field
