"""Every public function as a target of the fuzz, with what may be spoilt and the law its result keeps.

`tests/fuzz/test_fuzz.py` compares the targets with `torchdls.__all__`.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchdls
from tests.fuzz import functions as fn
from tests.fuzz.case import NAMES, Case, close, same_bits, tensors
from tests.fuzz.functions import Draw, Given, need
from tests.fuzz.integrators import REFUSED, WRONG_TENSORS


@dataclass
class Target:
    """One public function.

    Attributes:
        draw: a generator -> name -> code.
        law: (function, arguments, result), raises a Flaw.
        spoil: tensors that may be made wrong.
        batched: tensors whose surfaces must come out as alone; a tensor is left out where it has no batch dimension.
    """

    draw: Callable[[random.Random], dict[str, str]]
    law: Callable[[Any, Given, Any], None] | None = None
    spoil: tuple[str, ...] = ()
    batched: tuple[str, ...] = ()


# ---- files


def height_file_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 2)
    d.n = 1
    return {
        "suffix": repr(rng.choice([".npz", ".npy", ".tiff", ".png"])),
        "height": d.tensor(1),
        **d.maybe(mask=d.mask()),
    }


def same_height(f: Any, given: Given, found: Any) -> None:
    inside = given.get("mask", torch.ones_like(found.mask))
    z = torch.where(inside, given["height"], 0)
    back = torch.where(inside, found.height.to(z.dtype), 0)
    close(back, z, 2e-5 if given["suffix"] in (".png", ".tiff") else 0.0, "read back", 1e-4 * float(z.max() - z.min()))
    need(bool((found.mask == inside).all()), "another mask")


def mesh_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 2)
    d.n = 1
    return {
        "suffix": repr(rng.choice([".ply", ".obj", ".stl", ".glb"])),
        "points": f"torchdls.height_to_points({d.tensor(1)})",
    }


def kept_case(rng: random.Random) -> dict[str, str]:
    return {"name": repr(rng.choice(list(torchdls.INTEGRATORS)))}


def fields_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng, 2)
    d.n = 1
    return {"gradient": d.tensor(2), "weight": f"{d.tensor(1)}.abs()"}


def same_field(f: Any, given: Given, found: Any) -> None:
    need(same_bits(found.values.to(given["gradient"].dtype), given["gradient"]), "another gradient was read")
    need(same_bits(found.weight.to(given["weight"].dtype), given["weight"]), "another weight was read")


def write_height(suffix: str, height: Tensor, mask: Tensor | None = None) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        torchdls.save_height(f"{folder}/z{suffix}", height, mask=mask)
        found = torchdls.load_height(f"{folder}/z{suffix}")
        return found._replace(height=torch.where(found.mask, found.height, 0))  # NaN outside, as is promised


def write_mesh(suffix: str, points: Tensor) -> int:
    with tempfile.TemporaryDirectory() as folder:
        torchdls.save_mesh(f"{folder}/m{suffix}", points)
        return Path(f"{folder}/m{suffix}").stat().st_size


def write_field(gradient: Tensor, weight: Tensor) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        np.savez(f"{folder}/f.npz", gradient=gradient.numpy(), weight=weight.numpy())
        return torchdls.load_field(f"{folder}/f.npz")


def keep(name: str) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        one = torchdls.build(name)
        torchdls.save(f"{folder}/i.safetensors", one)
        need(repr(torchdls.load(f"{folder}/i.safetensors")) == repr(one), "another integrator was read")


def sample(name: str, n: Any) -> Any:
    return torchdls.SURFACES[name](n)


def camera_file(values: Tensor) -> Tensor:
    with tempfile.TemporaryDirectory() as folder:
        np.save(f"{folder}/k.npy", values.numpy())
        return torchdls.load_camera(f"{folder}/k.npy")


def mask_file(values: Tensor) -> Tensor:
    with tempfile.TemporaryDirectory() as folder:
        np.save(f"{folder}/m.npy", values[0, 0].numpy())
        return torchdls.load_mask(f"{folder}/m.npy")


def mask_file_case(rng: random.Random) -> dict[str, str]:
    d = Draw(rng)
    d.n = 1
    return {"values": d.mask()}


def same_mask(f: Any, given: Given, found: Tensor) -> None:
    need(same_bits(found, given["values"]), "another mask was read")


# What stands for a public function that takes a path: it writes and reads.
NAMES |= {f.__name__: f for f in (write_height, write_mesh, write_field, keep, sample, camera_file, mask_file)}

TARGETS: dict[str, Target] = {
    "torchdls.normals_to_gradient": Target(
        fn.normals_case, fn.there_and_back, ("normals", "mask"), ("normals", "mask")
    ),
    "torchdls.gradient_to_normals": Target(fn.gradient_case, fn.of_length_one, ("gradient",), ("gradient",)),
    "torchdls.convert_normals": Target(fn.convert_case("normals"), fn.converted_back, ("normals",), ("normals",)),
    "torchdls.convert_gradient": Target(fn.convert_case("gradient"), fn.converted_back, ("gradient",), ("gradient",)),
    "torchdls.guess_convention": Target(fn.guess_case, None, ("normals", "mask")),
    "torchdls.height_to_points": Target(fn.points_case, None, ("height",), ("height",)),
    "torchdls.depth_to_points": Target(fn.depth_case, None, ("depth",), ("depth",)),
    "torchdls.log_depth_to_depth": Target(fn.log_depth_case, None, (), ("log_depth",)),
    "torchdls.rmse": Target(
        fn.pair_case("height"), fn.free_of_constants, ("height", "reference", "mask"), ("height", "reference", "mask")
    ),
    "torchdls.mean_absolute_depth_error": Target(
        fn.pair_case("depth"), fn.free_of_scale, ("depth", "reference", "mask"), ("depth", "reference", "mask")
    ),
    "torchdls.mean_angular_error": Target(fn.angular_case, None, ("height", "reference"), ("height", "reference")),
    "torchdls.ssim": Target(fn.ssim_case, fn.like_itself, ("height", "reference"), ("height", "reference")),
    "torchdls.noise_level": Target(fn.noise_case, fn.scales, ("gradient",), ("gradient",)),
    "torchdls.noise_sigma": Target(fn.sigma_case, fn.scales, ("gradient", "mask"), ("gradient", "mask")),
    "lambda **given: torchdls.add_noise(generator=torch.Generator().manual_seed(0), **given)": Target(
        fn.add_noise_case, None, ("gradient", "mask")
    ),
    "torchdls.dct2": Target(fn.image_case, fn.inverse_of("idct2"), ("x",), ("x",)),
    "torchdls.idct2": Target(fn.image_case, fn.inverse_of("dct2"), ("x",), ("x",)),
    "torchdls.edge_slopes": Target(fn.edges_case, fn.linear_in_slopes, ("gradient", "mask", "weight")),
    "torchdls.GradientOperator": Target(fn.operator_case, fn.adjoint),
    "torchdls.Patches": Target(fn.patches_case, fn.patches_adjoint),
    "torchdls.woodham": Target(fn.photometric_case, fn.brighter, ("images", "lights", "mask", "lit")),
    "torchdls.sparse_normals": Target(fn.photometric_case, fn.brighter, ("images", "lights", "mask", "lit")),
    "torchdls.low_rank_normals": Target(fn.photometric_case, fn.brighter, ("images", "lights", "mask", "lit")),
    "torchdls.render": Target(fn.render_case, None, ("normals", "lights")),
    "torchdls.cast_shadows": Target(fn.shadow_case, fn.is_bool, ("height", "lights"), ("height",)),
    "torchdls.soup_dil_sweep": Target(fn.soup_case, fn.swept, ("P", "D", "B")),
    "torchdls.orthogonal_matching_pursuit": Target(fn.pursuit_case, fn.pursued, ("P", "D")),
    "torchdls.dct_dictionary": Target(fn.cosines_case, fn.unit_atoms),
    "torchdls.dls_objective": Target(fn.objective_case, None, ("height", "gradient", "dictionary", "codes")),
    "torchdls.hillshade": Target(fn.shade_case, fn.between_0_and_1, ("height",), ("height",)),
    "torchdls.select": Target(fn.select_case, None, ("gradient",)),
    "sample": Target(fn.surface_case),
    "write_height": Target(height_file_case, same_height),
    "write_mesh": Target(mesh_case),
    "write_field": Target(fields_case, same_field),
    "camera_file": Target(lambda rng: {"values": "torch.tensor([[9.0, 0, 3], [0, 9, 2], [0, 0, 1]])"}),
    "mask_file": Target(mask_file_case, same_mask),
    "keep": Target(kept_case),
}
# Drawn rarely: they load plotting libraries.
PICTURES: dict[str, Target] = {
    "torchdls.compare_heights": Target(fn.compare_case),
    "torchdls.surface_page": Target(fn.pages_case),
    "torchdls.surface_preview": Target(fn.preview_case),
}
# Public names that other cases call or read: by themselves they are nothing to fuzz.
ELSEWHERE = {
    "SURFACES": "sample", "save_height": "write_height", "load_height": "write_height", "save_mesh": "write_mesh",
    "load_field": "write_field", "load_camera": "camera_file", "load_mask": "mask_file", "save": "keep",
    "load": "keep", "build": "keep", "ring_of_lights": "woodham", "solve": "solve", "add_noise": "add_noise",
    "backends": "torchdls.soup_dil_sweep",
    "GradientToNormals": "gradient_to_normals", "NormalsToGradient": "normals_to_gradient", "page_html": "surface_page",
    "terrain": "no argument but a size; tests/test_surfaces.py", "Learner": "a protocol", "Integrator": "abstract",
    "Exact": "an option of DLS", "Implicit": "an option of DLS", "Proximal": "an option of DLS",
    "Unroll": "an option of DLS", "PHOTOMETRIC": "a table", "large": "tests/test_large.py",
    "bivariate_normals": "tests/photometric", "dlnv_normals": "tests/photometric", "dlpi_normals": "tests/photometric",
    "lights_from_ball": "tests/photometric", "refine": "tests/photometric", "load_photographs": "tests/cli",
    "save_normals": "tests/cli", "denoise_height": "tests/dictionary", "denoise_normals": "tests/test_normal_coder.py",
    "slope_noise": "tests/test_slope_noise.py", "OnlineDLS": "tests/sequences", "SequenceDLS": "tests/sequences",
    "SequencePatches": "tests/sequences", "fit_mesh": "tests/test_mesh.py", "NormalViews": "tests/test_mesh.py",
    "normal_noise": "tests/test_normal_coder.py", "integrate_many": "tests/batch", "reconstruct": "normals_to_gradient",
    "integrate_scattered": "tests/integrators/classic", "shrink_slow_waves": "tests/integrators/slope_dls",
    "fit_coarse": "tests/test_anchors.py", "place_pieces": "tests/test_anchors.py",
    "ConvergenceWarning": "a warning", "INTEGRATORS": "integrators.py", "LEARNERS": "learner",
}  # fmt: skip


def function(rng: random.Random) -> Case:
    """A call in order of a public function."""
    table = PICTURES if rng.random() < 0.01 else TARGETS
    code = rng.choice(list(table))
    target = table[code]
    return Case(code, target.draw(rng), judge=lambda *a: _judge(target, *a), label=code.rpartition(".")[2][:24])


def spoilt(rng: random.Random) -> Case:
    """The same with one tensor of another type, shape or dtype."""
    code = rng.choice([code for code, target in TARGETS.items() if target.spoil])
    target = TARGETS[code]
    given = target.draw(rng)
    name = rng.choice([name for name in target.spoil if name in given])
    wrongs = [w for w in WRONG_TENSORS if w not in ("None", "{}.to('meta')")]
    form = rng.choice(wrongs)
    if form == "{}.half()" and name in ("mask", "lit"):
        form = "{}.int()"
    if name == "lights" and form == "{}.half()":  # they are brought to the dtype of the images
        form = "{}.long()"
    given[name] = form.replace("{}", given[name])
    return Case(code, given, spoilt=name, must_raise=form in REFUSED, label="errors of functions")


def learner(rng: random.Random) -> Case:
    code, given = fn.learner_case(rng)
    return Case(code, given, judge=lambda case, f, values, result: fn.learned(f, values, result), label="learner")


def _judge(target: Target, case: Case, f: Any, given: Given, result: Any) -> None:
    if target.law is not None:
        target.law(f, given, result)
    first = given[target.batched[0]] if target.batched else None
    if not isinstance(first, Tensor) or first.ndim != 4 or isinstance(result, torch.nn.Module):
        return
    for i in range(len(first)):
        one = {k: t[i : i + 1] if k in target.batched else t for k, t in given.items()}
        for (name, alone), (_, together) in zip(tensors(f(**one)), tensors(result), strict=True):
            if together.shape[:1] == first.shape[:1]:
                if together.is_floating_point():
                    close(together[i : i + 1], alone, 1e-5, f"{name} of one surface", 1e-7)
                else:
                    need(same_bits(together[i : i + 1], alone), f"{name} of one surface is another")


MAKERS: list[tuple[Callable[[random.Random], Case], int]] = [(function, 40), (spoilt, 10), (learner, 8)]
