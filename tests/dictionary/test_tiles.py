"""A sweep over tiles, and over processes, is the sweep over all patches at once."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.helpers import seeded
from torchdls import dct_dictionary, soup_dil_sweep
from torchdls.dictionary import TiledSweep, learn_over_tiles


def patches(count=500, n=16):
    P = torch.randn(1, n, count, dtype=torch.float64, generator=seeded(0))
    return P, dct_dictionary((4, 4), dtype=torch.float64)[None]


@pytest.mark.parametrize("threshold", ["hard", "soft", "firm"])
@pytest.mark.parametrize("unused", ["first", "keep"])
@pytest.mark.parametrize("cuts", [[500], [1, 99, 400], [250, 250]])
def test_tiles_make_the_sweep_of_the_whole(threshold, unused, cuts):
    P, D = patches()
    B = torch.zeros(1, 16, 500, dtype=torch.float64)
    tiles = [
        (p.mT.contiguous().mT.clone(), b.clone()) for p, b in zip(P.split(cuts, -1), B.split(cuts, -1), strict=True)
    ]
    for mu in (1.5, 1.2, 3.6):  # the last one leaves most atoms without a patch
        sweep = TiledSweep(D, mu, 4.0, threshold=threshold, unused=unused)
        whole_D, B = soup_dil_sweep(P, D, B, mu, 4.0, "block", threshold=threshold, unused=unused)
        found = [sweep.codes(*tile) for tile in tiles]
        new = sweep.atoms()
        tiles = [(r + (D - new) @ b, b) for r, b in found]
        torch.testing.assert_close(new, whole_D, rtol=0, atol=1e-11)
        torch.testing.assert_close(torch.cat([b for _, b in tiles], -1), B, rtol=0, atol=1e-11)
        torch.testing.assert_close(torch.cat([r for r, _ in tiles], -1), P - whole_D @ B, rtol=0, atol=1e-11)
        D = new


def test_atoms_are_the_least_cost_one_by_one():
    """Against the definition, atom after atom with NumPy."""
    P, D = patches()
    sweep = TiledSweep(D, 1.0)
    B = torch.cat([sweep.codes(p.clone(), torch.zeros(1, 16, 50).double())[1] for p in P.split(50, -1)], -1)[0].numpy()
    expected, data = D[0].numpy().copy(), P[0].numpy()
    for i in range(16):
        rest = data - expected @ B + np.outer(expected[:, i], B[i])
        h = rest @ B[i]
        expected[:, i] = h / np.linalg.norm(h)
    np.testing.assert_allclose(sweep.atoms()[0].numpy(), expected, rtol=0, atol=1e-10)


def test_learning_lowers_the_cost_and_reads_each_tile_once_a_sweep():
    P, D = patches()
    read = []

    def tiles():
        for part in P.split(100, -1):
            read.append(part.shape[-1])
            yield part

    kept = P.clone()
    learned = learn_over_tiles(tiles, D, 1.5, n_sweeps=4)
    assert read == [100] * 20
    assert torch.equal(P, kept)
    expected = D
    for _ in range(4):
        expected, _ = soup_dil_sweep(P, expected, torch.zeros(1, 16, 500).double(), 1.5, order="block")
    torch.testing.assert_close(learned, expected, rtol=0, atol=1e-10)

    def cost(dictionary):
        B = soup_dil_sweep(P, dictionary, torch.zeros(1, 16, 500).double(), 1.5, learn=False)[1]
        return float((P - dictionary @ B).square().sum() + 1.5**2 * (B != 0).sum())

    assert cost(learned) < 0.98 * cost(D)


def test_more_than_one_dictionary():
    with pytest.raises(ValueError, match=r"D \(2, 4, 4\)"):
        TiledSweep(torch.zeros(2, 4, 4), 1.0)


RANK = """
import os
import sys

import torch

from torchdls.dictionary import learn_over_tiles, over_ranks
from tests.dictionary.test_tiles import patches

rank, (P, D) = int(os.environ["RANK"]), patches()
torch.distributed.init_process_group("gloo", init_method=f"file://{sys.argv[1]}/store", rank=rank, world_size=2)
own = P[..., :180] if rank == 0 else P[..., 180:]
torch.save(learn_over_tiles(lambda: own.split(70, -1), D, 1.5, 3, reduce=over_ranks), f"{sys.argv[1]}/{rank}.pt")
torch.distributed.destroy_process_group()
"""


@pytest.mark.slow
def test_two_processes_learn_one_dictionary(tmp_path):
    if not (torch.distributed.is_available() and torch.distributed.is_gloo_available()):
        pytest.skip("this PyTorch comes without gloo")
    root = Path(__file__).resolve().parents[2]
    started = [
        subprocess.Popen(
            [sys.executable, "-c", RANK, str(tmp_path)],
            cwd=root,
            env=os.environ | {"RANK": str(rank), "GLOO_SOCKET_IFNAME": "lo"},
        )
        for rank in range(2)
    ]
    assert [process.wait(timeout=120) for process in started] == [0, 0]
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    P, D = patches()
    assert torch.equal(first, second)
    torch.testing.assert_close(first, learn_over_tiles(lambda: [P], D, 1.5, 3), rtol=0, atol=1e-10)
