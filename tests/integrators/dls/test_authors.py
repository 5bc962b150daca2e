"""DLS beside the program of one of the paper's authors: heights, costs and nonzero codes of every dictionary."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchdls import DLS, DinoKat, Exact, SoupDIL

FIGURES = np.load(Path(__file__).resolve().parents[2] / "data" / "dls_authors_46x60.npz")


def option(name):
    if name == "soft":
        return {"learner": SoupDIL(threshold="soft")}
    return {"learner": {"hard": "soup_dil", "lowrank": DinoKat(rank=2), "fixed": "fixed", "unitary": "unitary"}[name]}


@pytest.mark.parametrize("name, height, cost", [
    ("hard", 1e-8, 1e-8), ("lowrank", 1e-8, 1e-8), ("fixed", 1e-8, 1e-8), ("unitary", 1e-8, 1e-8), ("soft", 4e-6, 1e-6),
])  # fmt: skip
def test_equals_the_authors_program(name, height, cost):
    method = DLS(
        lam=float(FIGURES["lam"]), mu=float(FIGURES["mu"]), n_iter=15, tol=0,
        height_step=Exact(1e-12), derivative="none",
        dictionary=torch.from_numpy(FIGURES["initial_dictionary"]), **option(name),
    )  # fmt: skip
    found = method.solve(torch.from_numpy(FIGURES["gradient"]))
    theirs = FIGURES[f"{name}_height"] - FIGURES[f"{name}_height"].mean()
    assert np.abs(found.height[0, 0].numpy() - theirs).max() < height * np.ptp(theirs)
    np.testing.assert_allclose(found.objective[0, 1:].numpy(), FIGURES[f"{name}_cost"], rtol=cost)
    assert int(found.codes.count_nonzero()) == int(FIGURES[f"{name}_nonzeros"])
    used = found.codes[0].any(1).numpy()  # the rest of an orthonormal dictionary is free
    theirs = FIGURES[f"{name}_dictionary"][:, used]
    np.testing.assert_allclose(found.dictionary[0].numpy()[:, used], theirs, atol=100 * height)
