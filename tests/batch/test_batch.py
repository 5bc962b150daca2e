"""`torchdls batch` from the outside: whole folders, one process and many, killed and resumed."""

import os
import random
import resource
import signal
import sys
import time

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers.maps import contents, digests, lines, slopes, start, write_map, write_maps
from torchdls import io
from torchdls.batch import Report
from torchdls.cli.main import main

SIZES = [(32, 32), (16, 48), (32, 32), (70, 66), (16, 48), (32, 32), (20, 18)]
LS = ("--method", "least_squares")


@pytest.fixture
def folder(tmp_path):
    write_maps(tmp_path / "in", SIZES)
    return tmp_path


def run(folder, *options, out="out", status=0, method=LS):
    assert main(["batch", str(folder / "in"), "--out", str(folder / out), *method, *map(str, options)]) == status
    return contents(folder / out)


def fails(capsys, *arguments):
    assert main([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("torchdls: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.mark.parametrize("method", [LS, ("--method", "slope_dls", "--set", "recipe=quick")])
def test_results_are_those_of_integrate_to_the_bit(folder, method):
    found = run(folder, "--format", "npz,npy", "--workers", 0, method=method)
    (folder / "single").mkdir()
    for k in range(len(SIZES)):
        outs = [part for s in ("npz", "npy") for part in ("-o", f"{folder}/single/m{k:03d}.{s}")]
        assert main(["integrate", f"{folder}/in/m{k:03d}.png", *outs, "--quiet", *method]) == 0
    assert found == contents(folder / "single")
    together = {line["input"][-8:-4]: line["together"] for line in lines(folder / "out")}
    assert method != LS or together == {"m000": 3, "m001": 2, "m002": 3, "m003": 1, "m004": 2, "m005": 3, "m006": 1}


def test_grouping_readers_and_threads_change_nothing(folder, capsys):
    found = run(folder, "--workers", 0)
    assert "7 done, 0 kept, 0 failed" in capsys.readouterr().out
    assert run(folder, "--memory", 1e-5, "--workers", 0, out="alone") == found
    assert {line["together"] for line in lines(folder / "alone")} == {1}
    assert run(folder, "--workers", 2, "--threads", 0, "--quiet", out="readers") == found
    capsys.readouterr()


def test_finished_maps_are_left_as_they_are(folder, capsys):
    found = run(folder)
    before = digests(folder / "out")
    (folder / "out" / "m002.npz").unlink()
    assert run(folder, "--resume") == found
    after = digests(folder / "out")
    assert {name for name in before if before[name] != after[name]} == {"m002.npz"}
    assert "1 done, 6 kept, 0 failed" in capsys.readouterr().out
    assert [line["status"] for line in lines(folder / "out")].count("done") == 8
    assert run(folder, "--force") == found
    again = digests(folder / "out")
    assert not {name for name in again if again[name] == after[name]}


def test_a_new_format_is_added(folder):
    run(folder)
    before = digests(folder / "out")
    found = run(folder, "--format", "npz,npy")
    after = digests(folder / "out")
    assert {name: after[name] for name in before} == before
    assert len(found) == 14


def test_layout_folders_with_mask_and_camera(tmp_path):
    write_map(tmp_path / "in" / "cat" / "view1" / "normal_map.png", slopes(24, 20))
    mask = np.zeros((24, 20), bool)
    mask[3:20, 4:18] = True
    Image.fromarray(mask).save(tmp_path / "in" / "cat" / "view1" / "mask.png")
    np.savetxt(tmp_path / "in" / "cat" / "view1" / "K.txt", [[60.0, 0, 10], [0, 60, 12], [0, 0, 1]])
    run(tmp_path, "--format", "npz,ply")
    with np.load(tmp_path / "out" / "cat" / "view1.npz") as found:
        np.testing.assert_array_equal(found["mask"], mask)
        assert found["depth"].shape == (24, 20)
    (tmp_path / "one").mkdir()
    arguments = ["integrate", str(tmp_path / "in" / "cat" / "view1"), "-o", str(tmp_path / "one" / "view1.npz"), *LS]
    assert main([*arguments, "--quiet"]) == 0
    assert contents(tmp_path / "one")["view1.npz"] == contents(tmp_path / "out")["cat/view1.npz"]
    assert main([*arguments, "--quiet", "--force", "--camera", "none"]) == 0
    assert io.load_height(tmp_path / "one" / "view1.npz").height.isfinite().sum() == mask.sum()
    with np.load(tmp_path / "one" / "view1.npz") as found:
        assert "height" in found


def test_integrate_needs_one_map(folder, capsys):
    assert "torchdls batch" in fails(capsys, "integrate", folder / "in", "-o", folder / "z.npz")


def test_a_list_on_standard_input(folder, monkeypatch):
    import io as text

    monkeypatch.setattr(sys, "stdin", text.StringIO(f"{folder}/in/m001.png\n{folder}/in/m003.png\n"))
    assert main(["batch", "-", "--out", str(folder / "out"), *LS, "--quiet"]) == 0
    assert list(contents(folder / "out")) == ["m001.npz", "m003.npz"]


def test_bad_maps_are_named_and_the_rest_goes_on(folder, capsys):
    good = run(folder, out="good", status=0)
    (folder / "in" / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    Image.fromarray(np.zeros((9, 9, 3), np.uint8)).save(folder / "in" / "black.png")
    nan = np.full((2, 8, 8), np.nan)
    np.save(folder / "in" / "nan.npy", nan)
    weight = np.full((32, 32), -1.0)
    np.savez(folder / "in" / "less.npz", gradient=slopes(32, 32)[0].numpy(), weight=weight)
    capsys.readouterr()
    assert run(folder, "--workers", 1, status=1) == good
    captured = capsys.readouterr()
    assert captured.err.count("torchdls: failed: ") == 4
    assert "7 done, 0 kept, 4 failed" in captured.out
    reasons = {line["input"].rpartition("/")[2]: line["reason"] for line in lines(folder / "out") if "reason" in line}
    assert set(reasons) == {"broken.png", "black.png", "nan.npy", "less.npz"}
    assert "broken.png" in reasons["broken.png"]
    assert "no pixel holds a normal" in reasons["black.png"]
    assert "no finite slope" in reasons["nan.npy"]
    assert "negative" in reasons["less.npz"]
    assert run(folder, "--quiet", status=1) == good  # tried again, reported again


def test_what_is_wrong_is_said_before_any_work(folder, capsys, monkeypatch):
    base = ("batch", folder / "in", "--out", folder / "out", *LS)
    assert "'xyz' is unknown" in fails(capsys, *base, "--format", "npz,xyz")
    assert "'magic' is unknown" in fails(capsys, *base, "--method", "magic")
    assert "none.png" in fails(capsys, "batch", folder / "none.png", "--out", folder / "out")
    assert "--memory" in fails(capsys, *base, "--memory", "0")
    assert "--workers" in fails(capsys, *base, "--workers", "-1")
    write_map(folder / "more" / "m001.png", slopes(8, 8))
    both = fails(capsys, "batch", folder / "in", folder / "more", "--out", folder / "out")
    assert "both results would be called m001.npz" in both
    for rank, world, match in (("2", "2", "do not fit"), ("x", "2", "RANK='x'")):
        monkeypatch.setenv("RANK", rank)
        monkeypatch.setenv("WORLD_SIZE", world)
        assert match in fails(capsys, *base)
    monkeypatch.undo()
    (folder / "file").write_text("")
    assert "file" in fails(capsys, "batch", folder / "in", "--out", folder / "file")
    assert not (folder / "out").exists()


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_to(folder, capsys):
    (folder / "out").mkdir(mode=0o500)
    assert "out" in fails(capsys, "batch", folder / "in", "--out", folder / "out", *LS)


def test_a_full_disk_ends_the_run(folder, capsys, monkeypatch):
    def full(*arguments, **options):
        raise OSError(28, "No space left on device", str(arguments[0]))

    monkeypatch.setattr(io, "save_height", full)
    assert "No space left" in fails(capsys, "batch", folder / "in", "--out", folder / "out", *LS, "--quiet")
    assert {line["status"] for line in lines(folder / "out")} == {"failed"}
    assert not contents(folder / "out")
    assert not list((folder / "out" / ".torchdls" / "claims").iterdir())
    monkeypatch.undo()
    assert len(run(folder)) == len(SIZES)


def test_a_report_that_cannot_be_written_is_named(tmp_path):
    """A file may grow to ten bytes, as on a disk with no more room: the rest of the line finds none."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
        with Report(tmp_path / "report.jsonl") as report:
            for reason in ("No space left", "File too large"):  # a line that is cut, and one with no room at all
                with pytest.raises(OSError, match=f"{reason}.*report.jsonl"):
                    report.line(status="done")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_other_options_in_one_folder_are_refused(folder, capsys):
    run(folder)
    base = ("batch", folder / "in", "--out", folder / "out")
    assert '--method "least_squares", "slope_dls" is asked for' in fails(capsys, *base)
    assert "--convention null" in fails(capsys, *base, *LS, "--convention", "directx")
    before = digests(folder / "out")
    changed = run(folder, "--convention", "directx", "--force", "--quiet")
    assert all(changed[name] != before[name][0] for name in before)


def test_ranks_share_the_work_in_turn(folder, monkeypatch):
    """One after the other: the first takes over what the second has not begun; the second finds all done."""
    found = run(folder, out="single")
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in ("1", "0"):
        monkeypatch.setenv("RANK", rank)
        assert run(folder, "--quiet") == found
    told = {path.name: len(path.read_text().splitlines()) for path in (folder / "out").glob("*.jsonl")}
    assert told == {"report-1.jsonl": 7, "report-0.jsonl": 4}  # all done, and the own share kept
    monkeypatch.setenv("RANK", "1")
    before = digests(folder / "out")
    run(folder, "--force", "--quiet")
    after = digests(folder / "out")
    assert {name for name in before if before[name] != after[name]} == {"m001.npz", "m003.npz", "m005.npz"}


def test_an_interrupt_lets_go_of_what_was_claimed(folder, capsys, monkeypatch):
    from torchdls.batch import run as module

    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "together", stop)
    assert main(["batch", str(folder / "in"), "--out", str(folder / "out"), *LS, "--quiet"]) == 130
    assert not list((folder / "out" / ".torchdls" / "claims").iterdir())
    assert not list((folder / "out" / ".torchdls" / "owners").iterdir())


# --- processes that are killed --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(int(os.environ.get("TORCHDLS_KILLS", "2"))))
def test_a_rank_is_killed_and_the_work_is_whole(tmp_path, seed):
    sizes = [((16, 32), (32, 16), (20, 20), (23, 30))[k % 4] for k in range(60)]
    write_maps(tmp_path / "in", sizes)
    method = ("--method", "slope_dls", "--set", "recipe=quick")
    found = run(tmp_path, "--quiet", out="single", method=method)
    arguments = ("batch", tmp_path / "in", "--out", tmp_path / "out", *method, "--workers", seed % 2)
    ranks = [start(*arguments, rank=rank, world=2) for rank in range(2)]
    draw = random.Random(seed)
    point, victim = draw.randrange(len(sizes)), draw.randrange(2)
    while len(contents(tmp_path / "out")) < point and ranks[victim].poll() is None:
        time.sleep(0.01)
    time.sleep(draw.random() * 0.1)
    ranks[victim].send_signal(signal.SIGKILL)
    ranks[victim].communicate()
    before = digests(tmp_path / "out")
    said, _ = ranks[1 - victim].communicate(timeout=300)
    assert ranks[1 - victim].returncode == 0, said
    between = digests(tmp_path / "out")
    assert contents(tmp_path / "out") == found  # the other one took over, and all is whole
    run(tmp_path, "--quiet", method=method)
    after = digests(tmp_path / "out")
    assert all(between[name] == before[name] for name in before)
    assert after == between
    told = [line["input"] for line in lines(tmp_path / "out") if line["status"] == "done"]
    assert len(told) == len(set(told))  # none twice
    assert not list((tmp_path / "out" / ".torchdls" / "claims").iterdir())


@pytest.mark.slow
def test_killed_alone_and_resumed(tmp_path):
    write_maps(tmp_path / "in", [(32, 32)] * 30)
    method = ("--method", "slope_dls", "--set", "recipe=quick")
    found = run(tmp_path, "--quiet", out="single", method=method)
    process = start("batch", tmp_path / "in", "--out", tmp_path / "out", *method, "--memory", "1e-4", "--workers", 0)
    while not contents(tmp_path / "out") and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = digests(tmp_path / "out")
    assert 0 < len(before) < 30
    assert run(tmp_path, "--quiet", method=method) == found
    after = digests(tmp_path / "out")
    assert all(after[name] == before[name] for name in before)


def test_the_tensors_of_a_map_travel_whole(tmp_path):
    """As arrays between processes: masks, weights and doubles arrive as they were."""
    from torchdls.batch import Manner, Map, Source
    from torchdls.batch.run import _as_array, _as_tensor, _Files

    weight = np.random.default_rng(0).random((12, 9))
    mask = weight > 0.2
    np.savez(tmp_path / "g.npz", gradient=slopes(12, 9)[0].double().numpy(), mask=mask, weight=weight)
    (read,) = _Files([_job(tmp_path / "g.npz")], Manner())[[0]]
    found = Map(*map(_as_tensor, read.content))
    assert found.gradient.dtype == torch.float64
    np.testing.assert_array_equal(found.mask[0, 0], mask)
    np.testing.assert_array_equal(found.weight[0, 0], weight)
    assert isinstance(_as_array(found).gradient, np.ndarray)
    assert isinstance(read, type(read))
    assert Source(str(tmp_path / "g.npz")) == _job(tmp_path / "g.npz").source


def _job(path):
    from torchdls.batch import Job, Source

    return Job(Source(str(path)), path.stem, ())
