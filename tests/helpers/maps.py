"""Small normal maps in files, and what lies in a folder of results."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from torchdls import gradient_to_normals
from torchdls.surfaces import SURFACES

ROOT = Path(__file__).resolve().parents[2]


def slopes(h, w, seed=0):
    """(1, 2, h, w) noisy slopes, other ones for every seed."""
    g = SURFACES["peaks"](max(h, w), dtype=torch.float32).gradient[..., :h, :w]
    noise = torch.randn(g.shape, generator=torch.Generator().manual_seed(seed))
    return g * (0.4 + 0.1 * (seed % 5)) + 0.05 * noise


def write_map(path, gradient):
    """The normals of a gradient as a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    normals = gradient_to_normals(gradient)[0].permute(1, 2, 0).numpy()
    Image.fromarray(np.rint((normals + 1) / 2 * 255).astype(np.uint8)).save(path)


def write_maps(folder, sizes):
    """Maps m000.png, m001.png, .. of these sizes."""
    for k, (h, w) in enumerate(sizes):
        write_map(folder / f"m{k:03d}.png", slopes(h, w, k))


def digests(folder):
    """The results of a folder, by their names: what they hold and when they were written."""
    files = [p for p in sorted(Path(folder).rglob("*")) if p.is_file() and p.suffix in (".npz", ".npy", ".ply")]
    return {
        p.relative_to(folder).as_posix(): (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns)
        for p in files
    }


def contents(folder):
    """The results of a folder by their names, without their times."""
    return {name: digest for name, (digest, _) in digests(folder).items()}


def lines(folder):
    """The lines of all reports of a folder."""
    return [json.loads(line) for path in sorted(Path(folder).glob("*.jsonl")) for line in path.read_text().splitlines()]


def start(*arguments, rank=0, world=1):
    """`torchdls` in a process of its own."""
    environment = os.environ | {"RANK": str(rank), "WORLD_SIZE": str(world), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torchdls", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
