"""Claims: one holder at a time, the dead are found out, nobody takes twice."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from torchdls.batch import Claims

ROOT = Path(__file__).resolve().parents[2]


def never():
    return False


def left_behind(folder, name):
    """A claim of a process that was killed."""
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom torchdls.batch.claims import Claims\n"
        "c = Claims(Path(sys.argv[1])).__enter__()\nassert c.take(sys.argv[2], lambda: False)\nos.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder), name], cwd=ROOT, check=False)
    assert done.returncode == -9


def test_one_holder_at_a_time(tmp_path):
    with Claims(tmp_path) as a, Claims(tmp_path) as b:
        assert a.take("x", never)
        assert not b.take("x", never)
        assert not a.take("x", never)
        assert b.take("y", never)
        a.release("x")
        assert b.take("x", never)
        assert not a.take("x", never)
    assert not list((tmp_path / "claims").iterdir())
    assert not list((tmp_path / "owners").iterdir())


def test_what_was_done_meanwhile_is_not_taken(tmp_path):
    with Claims(tmp_path) as a:
        assert not a.take("x", lambda: True)
        assert a.take("x", never)


def test_a_failure_is_not_tried_again_by_those_who_run(tmp_path):
    with Claims(tmp_path) as a, Claims(tmp_path) as b:
        time.sleep(0.02)  # files are stamped by the ticks of the system's clock
        assert a.take("x", never)
        a.fail("x")
        assert not b.take("x", never)
        assert b.has_failed("x")
    time.sleep(0.02)
    with Claims(tmp_path) as later:
        assert later.take("x", never)
        later.succeed("x")
        assert not list((tmp_path / "failed").iterdir())


def test_the_dead_are_taken_over_once(tmp_path):
    left_behind(tmp_path, "x")
    with ThreadPoolExecutor(8) as pool:
        claims = [Claims(tmp_path).__enter__() for _ in range(8)]
        took = list(pool.map(lambda c: c.take("x", never), claims))
    assert sum(took) == 1
    winner = claims[took.index(True)]
    winner.release("x")
    assert not list((tmp_path / "claims").iterdir())
    for c in claims:
        c.__exit__(None, None, None)


def test_elsewhere_the_age_tells(tmp_path):
    with Claims(tmp_path, age=60) as a:
        owner = tmp_path / "owners" / "othermachine-1-abc"
        owner.touch()
        assert a.take("x", never)
        (claim,) = (tmp_path / "claims").iterdir()
        claim.write_text(owner.name)
        with Claims(tmp_path, age=60) as b:
            assert not b.take("x", never)
            os.utime(owner, (time.time() - 100,) * 2)
            assert b.take("x", never)
            owner.unlink()


def test_an_owner_shows_that_it_lives(tmp_path):
    with Claims(tmp_path, age=0.3):
        (owner,) = (tmp_path / "owners").iterdir()
        os.utime(owner, (0, 0))
        end = time.monotonic() + 20
        while owner.stat().st_mtime < 1 and time.monotonic() < end:
            time.sleep(0.02)
        assert owner.stat().st_mtime > 1


@pytest.mark.slow
def test_many_threads_take_everything_once(tmp_path):
    def work(k):
        with Claims(tmp_path) as claims:
            took = []
            for i in range(100):
                done = tmp_path / f"done{i}"
                if claims.take(str(i), done.exists):
                    took.append(i)
                    done.touch()
                    claims.succeed(str(i))
            return took

    with ThreadPoolExecutor(6) as pool:
        took = [i for part in pool.map(work, range(6)) for i in part]
    assert sorted(took) == list(range(100))


def test_a_claim_that_cannot_be_signed_is_none(tmp_path, monkeypatch):
    """On a full disk a file is made, but holds nothing."""

    def full(file, text):
        raise OSError(28, "No space left on device")

    with Claims(tmp_path) as claims:
        monkeypatch.setattr("torchdls.batch.claims.os.write", full)
        with pytest.raises(OSError, match=rf"No space left on device: '{tmp_path}.*claims") as caught:
            claims.take("a", lambda: False)
        assert not list((tmp_path / "claims").iterdir())
        monkeypatch.undo()
        assert claims.take("a", lambda: False)
    assert caught.value.errno == 28
