"""DLS beside the program of one of the paper's authors: heights, costs and nonzero codes of every dictionary."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchdls import DLS, DinoKat, Exact, SoupDIL

FIGURES = np.load(Path(__file__).resolve().parents[2] / "data" / "dls_authors_46x60.npz")
LEARNERS = {
    "hard": "soup_dil",
    "soft": SoupDIL(threshold="soft"),
    "lowrank": DinoKat(rank=2),
    "fixed": "fixed",
    "unitary": "unitary",
}


@pytest.mark.parametrize("name", LEARNERS)
def test_equals_the_authors_program(name):
    dictionary = torch.from_numpy(FIGURES["initial_dictionary"])
    lam, mu = float(FIGURES["lam"]), float(FIGURES["mu"])
    options = {"lam": lam, "mu": mu, "tol": 0, "height_step": Exact(1e-14), "derivative": "none"}
    options |= {"dictionary": dictionary, "learner": LEARNERS[name]}
    gradient = torch.from_numpy(FIGURES["gradient"])[None]
    # Their program takes its atoms as they are, and those of the file are rounded to float32: of length 1 up to 4e-8,
    # which soft thresholds make 1e-6 of in 15 iterations. DLS makes them of length 1, but for those of a `start`.
    start = DLS(n_iter=0, **options).solve(gradient)._replace(dictionary=dictionary[None])
    found = DLS(n_iter=15, **options).solve(gradient, start=start)
    theirs = FIGURES[f"{name}_height"] - FIGURES[f"{name}_height"].mean()
    assert np.abs(found.height[0, 0].numpy() - theirs).max() < 1e-8 * np.ptp(theirs)
    np.testing.assert_allclose(found.objective[0, 1:].numpy(), FIGURES[f"{name}_cost"], rtol=1e-8)
    assert int(found.codes.count_nonzero()) == int(FIGURES[f"{name}_nonzeros"])
    used = found.codes[0].any(1).numpy()  # the rest of an orthonormal dictionary is free
    theirs = FIGURES[f"{name}_dictionary"][:, used]
    np.testing.assert_allclose(found.dictionary[0].numpy()[:, used], theirs, atol=1e-8)
