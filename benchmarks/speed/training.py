"""What a step of training costs: `python -m benchmarks.speed.training` (half a minute; --smoke for a short run).

Seconds of a forward pass that records nothing, of one that records, and of the backward pass, each the least of some
repetitions on one field of terrain at 10 dB, float32; and the memory that is kept between the two, by the hooks of
PyTorch for saved tensors, each storage once. Writes training.md and the table in docs/differentiation.md.
"""

from __future__ import annotations

import argparse
import time

import torch
from torch.autograd.graph import saved_tensors_hooks

from benchmarks.common.report import ROOT, made_by, markdown_table, replace_section, results_folder
from torchdls import DLS, Integrator, LeastSquares, SlopeDLS, add_noise, terrain

METHODS: dict[str, Integrator] = {
    "LeastSquares()": LeastSquares(),
    "SlopeDLS.fast()": SlopeDLS.fast(),
    "SlopeDLS()": SlopeDLS(),
    'SlopeDLS(recipe="plain")': SlopeDLS(recipe="plain"),
    'DLS(learn="fixed", n_iter=10)': DLS(learn="fixed", n_iter=10),
    "DLS(n_iter=5), unrolled": DLS(n_iter=5, tol=0.0),
}


def measure(method: Integrator, size: int, repetitions: int) -> tuple[float, float, float, float]:
    """Seconds of the plain forward, the recorded one and the backward pass, and the megabytes kept."""
    surface = terrain(size, smoothing=2.0)
    field = add_noise(surface.gradient, 10, generator=torch.Generator().manual_seed(0)).requires_grad_()
    spent: list[list[float]] = [[], [], []]
    kept: dict[int, int] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    for _ in range(repetitions):
        kept.clear()
        start = time.perf_counter()
        with torch.no_grad():
            method(field)
        spent[0].append(time.perf_counter() - start)
        start = time.perf_counter()
        with saved_tensors_hooks(keep, lambda tensor: tensor):
            height = method(field)
        spent[1].append(time.perf_counter() - start)
        loss = (height - surface.height).square().mean()
        start = time.perf_counter()
        loss.backward()
        spent[2].append(time.perf_counter() - start)
    plain, recorded, backward = map(min, spent)
    return plain, recorded, backward, sum(kept.values()) / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true")
    smoke = parser.parse_args().smoke
    size, repetitions = (24, 1) if smoke else (128, 4)
    torch.set_num_threads(1)
    rows = [[f"`{name}`", *measure(method, size, repetitions)] for name, method in METHODS.items()]
    table = markdown_table(["", "forward, s", "recorded, s", "backward, s", "kept, MB"], rows)
    text = f"{table}\n{made_by('benchmarks.speed.training')}"
    path = results_folder(smoke) / "training.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    if not smoke:
        replace_section(ROOT.parent / "docs" / "differentiation.md", "training", text)
    print(text)


if __name__ == "__main__":
    main()
