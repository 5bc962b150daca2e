"""The paper's order on the patches that an atom is in alone, against all rows of a group on all patches."""

import pytest
import torch

from tests.helpers import random_field
from torchdls import _compiled
from torchdls.dictionary import soup_dil, sweep_rows
from torchdls.dictionary.soup_dil import residual_sweep


@pytest.mark.parametrize("many", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("unused", ["first", "keep"])
@pytest.mark.parametrize("by_patch", [True, False])
def test_few_patches_are_all_that_matter(by_patch, unused, many, monkeypatch):
    """Atoms in no patch, in few and in most of them; R and B where they were, in either layout."""
    R, D, B = (random_field(2, *shape, seed=k) for k, shape in enumerate([(6, 40), (6, 19), (19, 40)]))
    D, B = D / D.norm(dim=1, keepdim=True), torch.where(B.abs() < 1.2, 0, B)
    mu = torch.linspace(0.1, 3, 19).double()
    mu[4], B[:, 4] = 100, 0
    R = R.mT.contiguous().mT if by_patch else R
    monkeypatch.setattr(_compiled, "installed", lambda: False)
    expected = residual_sweep(R.clone(), D, B.clone(), mu, 4.0, unused=unused)
    monkeypatch.setattr(soup_dil, "_SHORTEST", 1)
    monkeypatch.setattr(sweep_rows, "_MANY", many)
    found = residual_sweep(R, D, B, mu, 4.0, unused=unused)
    share = (found[2] != 0).double().mean(2)
    assert share.min() == 0
    assert share.max() > 0.3
    assert found[0].data_ptr() == R.data_ptr()
    assert found[2].data_ptr() == B.data_ptr()
    assert torch.equal(found[2] != 0, expected[2] != 0)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)
