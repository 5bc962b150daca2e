"""`torchdls batch`: folders of maps to surfaces, by one process or many."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdls._registry import INTEGRATORS
from torchdls.cli.integrate import METHOD, add_manner, manner
from torchdls.cli.methods import build_method, check_method

if TYPE_CHECKING:
    from torchdls.batch import Job, Progress, Setting

STATE = ".torchdls"  # beside the results: claims, and what the run was asked for


def add_batch(commands: Any) -> None:
    """Add the command `batch`."""
    command = commands.add_parser(
        "batch",
        help="folders of normal maps or gradients to surfaces, by one process or many",
        description="Integrate every map of the inputs. Results are named by the paths of their inputs, written whole "
        "or not at all, and never done again once they are there. Started as several processes (RANK and "
        "WORLD_SIZE, as torchrun sets them), they share the work.",
    )
    add = command.add_argument
    add("input", nargs="+", metavar="INPUT", help="file, pattern, or folder, in which each file is a map and each "
        "folder with normal_map.png, with its mask.png and K.txt; - for a list on standard input")  # fmt: skip
    add("-o", "--out", required=True, metavar="DIR", help="folder for the results; made if it is missing")
    add("--format", default="npz", metavar="F,F", help="npz, npy, tiff, png, ply, obj, stl, glb (default: npz)")
    add("--method", default=METHOD, help=f"{', '.join(INTEGRATORS)} (default: {METHOD})")
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="option of the method, such as lam=0.5")
    add_manner(command)
    again = command.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="leave finished maps as they are (this is the default)")
    again.add_argument(
        "--force", action="store_true", help="do all maps anew; several processes then keep to their share"
    )
    add("--report", metavar="FILE", help="a line of JSON for each map is added to it (default: report.jsonl in DIR; "
        "process N of several writes report-N.jsonl)")  # fmt: skip
    add("--state", metavar="DIR", help="folder for claims, on disks that all processes share (default: .torchdls in "
        "the folder for results; needed where that is in a store, such as s3://bucket/surfaces)")  # fmt: skip
    add("--memory", type=float, default=1.0, metavar="GB", help="for maps that wait, in work or being written, "
        "beside what one large map needs (default: 1)")  # fmt: skip
    add("--workers", type=int, metavar="N", help="processes that read (default: the cores of this process, less one)")
    add("--threads", type=int, default=1, metavar="N", help="for maps from 512 x 512 pixels on, whose last bits depend "
        "on it; 0 is the cores of this process (default: 1: start one process for each core)")  # fmt: skip
    add("--claim-age", type=float, default=120.0, metavar="S", help="seconds without a sign of life after which a "
        "process on another machine is gone (default: 120)")  # fmt: skip
    add("--quiet", action="store_true", help="no progress and no summary")
    command.set_defaults(run=_batch)


def _batch(arguments: argparse.Namespace) -> int:
    from torchdls.batch import Claims, Progress, Report, Run

    check_method(arguments.method, arguments.set)
    setting = _setting(arguments)
    state = _state(arguments)
    jobs = _jobs(arguments)
    state.mkdir(parents=True, exist_ok=True)
    report = _report_path(arguments, state, setting)
    _check_asked(arguments, state)
    share = len(range(setting.rank, len(jobs), setting.world))
    progress = Progress(share, arguments.quiet)
    with Claims(state, setting.age) as claims, Report(report) as lines:
        _say(arguments, f"{len(jobs)} maps, {_how(setting)}")
        left = Run(jobs, setting, claims, lines, progress).all()
    return _end(arguments, progress, report, left)


def _state(arguments: argparse.Namespace) -> Path:
    """The folder for claims, which must make files exclusively: not one in a store."""
    from torchdls.batch.stores import is_url

    if arguments.state is not None:
        return Path(arguments.state)
    if is_url(arguments.out):
        raise ValueError(
            f"--out: {arguments.out} is in a store; --state DIR, on disks that all processes share, is needed"
        )
    return Path(arguments.out, STATE)


def _setting(arguments: argparse.Namespace) -> Setting:
    from torchdls.batch import Setting

    rank, world = (_count(name, default) for name, default in (("RANK", 0), ("WORLD_SIZE", 1)))
    if not 0 <= rank < world:
        raise ValueError(f"RANK={rank} and WORLD_SIZE={world} do not fit: from 0 to below WORLD_SIZE is needed")
    if not arguments.memory > 0 or not arguments.claim_age > 0:
        raise ValueError(f"--memory {arguments.memory:g}, --claim-age {arguments.claim_age:g}: both must be positive")
    cores = max(1, _cores() // _count("LOCAL_WORLD_SIZE", world))
    workers = min(4, cores - 1) if arguments.workers is None else arguments.workers
    if workers < 0 or arguments.threads < 0:
        raise ValueError(f"--workers {workers}, --threads {arguments.threads}: at least 0 is needed")
    return Setting(
        manner(arguments),
        arguments.method,
        lambda pixel_size, camera: build_method(arguments.method, pixel_size, arguments.set, camera=camera),
        overwrite=arguments.force,
        memory=int(arguments.memory * 2**30),
        workers=workers if hasattr(os, "fork") else 0,
        threads=arguments.threads or cores,
        use_threads=_use_threads,
        rank=rank,
        world=world,
        age=arguments.claim_age,
    )


def _use_threads(n: int) -> None:
    """The command line owns its process, so it may say how many threads it has."""
    import torch

    if torch.get_num_threads() != n:
        torch.set_num_threads(n)


def _count(name: str, default: int) -> int:
    text = os.environ.get(name, str(default))
    if not text.isdigit():
        raise ValueError(f"{name}={text!r} in the environment, a number is needed")
    return int(text)


def _cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _jobs(arguments: argparse.Namespace) -> list[Job]:
    from torchdls._files import require
    from torchdls.batch import find_maps, listed_maps, plan
    from torchdls.io import OUTPUT_SUFFIXES

    suffixes = [f".{name.strip().lower().removeprefix('.')}" for name in arguments.format.split(",")]
    for suffix in suffixes:
        if suffix not in OUTPUT_SUFFIXES:
            known = ", ".join(s[1:] for s in OUTPUT_SUFFIXES)
            raise ValueError(f"--format: {suffix[1:]!r} is unknown; choose from {known}")
    for library, needing in (("tifffile", (".tif", ".tiff")), ("trimesh", (".ply", ".obj", ".stl", ".glb"))):
        if set(needing) & set(suffixes):
            require(library, "files")
    found = find_maps([text for text in arguments.input if text != "-"], leave_out=arguments.out)
    if "-" in arguments.input:
        found += listed_maps(sys.stdin)
    return plan(found, arguments.out, list(dict.fromkeys(suffixes)))


def _report_path(arguments: argparse.Namespace, state: Path, setting: Setting) -> Path:
    beside = Path(arguments.out) if state == Path(arguments.out, STATE) else state
    path = beside / "report.jsonl" if arguments.report is None else Path(arguments.report)
    return path if setting.world == 1 else path.with_name(f"{path.stem}-{setting.rank}{path.suffix}")


def _check_asked(arguments: argparse.Namespace, state: Path) -> None:
    """One folder holds the results of one method with one set of options; ValueError for a run that asks for others."""
    from torchdls._files import atomic_file

    names = ("method", "set", "channels", "convention", "pixel_size", "camera", "float64")
    asked = {name: getattr(arguments, name) for name in names}
    place = state / "asked.json"
    if not place.exists() or arguments.force:
        try:
            with atomic_file(place, overwrite=arguments.force) as file:
                file.write(json.dumps(asked).encode())
            return
        except FileExistsError:  # by another process, just now
            pass
    stored = json.loads(place.read_text())
    for name in names:
        if stored.get(name) != asked[name]:
            before, now = (json.dumps(values.get(name)) for values in (stored, asked))
            raise ValueError(
                f"{arguments.out}: holds results with --{name.replace('_', '-')} {before}, {now} is asked for; "
                "choose another --out, or --force to do all maps anew"
            )


def _how(setting: Setting) -> str:
    rank = "" if setting.world == 1 else f"rank {setting.rank} of {setting.world}, "
    large = f", {setting.threads} for large maps" if setting.threads > 1 else ""
    return f"{rank}1 thread{large}, {setting.workers} readers, {setting.memory / 2**30:.3g} GB for maps in work"


def _say(arguments: argparse.Namespace, text: str) -> None:
    if not arguments.quiet:
        print(f"batch: {text}", flush=True)


def _end(arguments: argparse.Namespace, progress: Progress, report: Path, left: int) -> int:
    for reason in progress.failures[:5]:
        print(f"torchdls: failed: {reason}", file=sys.stderr)
    failed = progress.counts["failed"]
    if failed > 5:
        print(f"torchdls: failed: {failed - 5} more, see {report}", file=sys.stderr)
    other = f", {left} in work by other processes" if left else ""
    counts = f"{progress.counts['done']} done, {progress.counts['kept']} kept, {failed} failed{other}"
    _say(arguments, f"{counts}, {progress.rate:.1f} maps a second; {report}")
    return 1 if failed else 0
