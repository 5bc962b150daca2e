"""The store of tables: bounded in bytes, least recently used first out, the same values whatever it holds."""

import threading

import pytest
import torch

from tests.helpers import MASKS, random_field
from torchdls import LeastSquares, SlopeDLS
from torchdls._caches import LIMIT, STORE, Store, weight


def kilobyte():
    return torch.zeros(256, dtype=torch.float32)


def test_what_was_used_least_recently_goes_first():
    store, made = Store(3500), []

    def find(key):
        def make():
            made.append(key)
            return kilobyte()

        return store.find(key, make)

    for key in "abc":
        assert find(key) is find(key)
    find("a")
    find("d")  # b goes
    assert made == list("abcd")
    find("a")
    find("b")  # c goes
    assert made == list("abcdb")
    assert store.held == 3 * weight(kilobyte()) <= 3500


def test_what_is_larger_than_the_whole_is_not_kept():
    store = Store(1000)
    assert len(store.find("large", kilobyte)) == 256
    assert store.held == 0
    store.find("small", lambda: torch.zeros(10))
    store.find("large", kilobyte)
    assert store.held == weight(torch.zeros(10))


def test_bytes_are_counted_in_nested_tuples():
    assert weight((kilobyte(), [kilobyte()], None)) == pytest.approx(2048, abs=600)
    assert weight(b"x" * 5000) == pytest.approx(5000, abs=200)


def test_all_that_is_kept_stays_within_the_limit(monkeypatch):
    """Many sizes and masks, far beyond it; and heights are the same when nothing is kept."""
    g = random_field(1, 2, 40, 44)
    inside = MASKS["sieve"](40, 44)
    w = 1e-6 + random_field(1, 1, 40, 44, seed=3).exp() ** 4
    kept = [LeastSquares()(g), LeastSquares()(g, inside, w), SlopeDLS.fast()(g)]
    monkeypatch.setattr(STORE, "limit", 200_000)
    before = STORE.held
    for n in range(20, 40):
        LeastSquares()(g[..., :n, :n])
        LeastSquares()(g[..., :n, :n], inside[..., :n, :n], w[..., :n, :n])
    assert STORE.held <= max(before, 200_000)
    assert STORE.held == sum(size for _, size in STORE._values.values()) <= 200_000
    monkeypatch.setattr(STORE, "limit", 0)
    again = [LeastSquares()(g), LeastSquares()(g, inside, w), SlopeDLS.fast()(g)]
    for a, b in zip(kept, again, strict=True):
        assert torch.equal(a, b)


def test_the_limit_is_the_one_that_is_documented():
    assert STORE.limit == LIMIT == 576 * 2**20


def test_threads_may_ask_at_once():
    store, found = Store(5000), []

    def ask():
        for i in range(200):
            found.append(store.find(i % 7, lambda i=i: torch.full((256,), float(i % 7)))[0].item() == i % 7)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(found)
    assert len(found) == 800
    assert store.held == sum(size for _, size in store._values.values()) <= 5000
