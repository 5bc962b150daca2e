"""Integrators, learners and photometric methods by name, without loading any: a name costs nothing until it is used."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

    from torchdls.dictionary import Learner
    from torchdls.integrators import Integrator

T = TypeVar("T")


class Registry(Mapping[str, type[T]]):
    """A read-only table from names to classes of `torchdls`, each imported when it is looked up.

    Iterating, `len` and `in` import nothing, so that the command line can list the names before PyTorch is loaded.

    Args:
        classes: name -> name of a class that `torchdls` exports, or "package.module.Class" of any other.
    """

    def __init__(self, classes: Mapping[str, str]) -> None:
        self._classes = dict(classes)

    def __getitem__(self, name: str) -> type[T]:
        """The class of that name; KeyError, with the known names, if there is none."""
        if name not in self._classes:
            raise KeyError(f"{name!r} is unknown; choose from {', '.join(self)}")
        module, _, attribute = self._classes[name].rpartition(".")
        found: type[T] = getattr(import_module(module or "torchdls"), attribute)
        return found

    def find(self, name: str) -> Any:
        """As [name], for tables of functions."""
        return self[name]

    def __contains__(self, name: object) -> bool:
        return name in self._classes

    def __iter__(self) -> Iterator[str]:
        return iter(self._classes)

    def __len__(self) -> int:
        return len(self._classes)

    def __repr__(self) -> str:
        return f"Registry({', '.join(self)})"

    def name_of(self, wanted: type) -> str | None:
        """The name of a class, or None if it is not in the table."""
        return next((name for name, found in self.items() if found is wanted), None)

    def summary(self, name: str) -> str:
        """What the method is, in one line: the first of its docstring."""
        return (inspect.getdoc(self[name]) or "").partition("\n")[0]

    def parameters(self, name: str) -> dict[str, Any]:
        """The options of the method and their defaults."""
        return {p.name: p.default for p in inspect.signature(self[name]).parameters.values()}


def camera_options(name: str, camera: Tensor | None) -> dict[str, Any]:
    """What the integrator of that name is told of a camera K (3, 3) or (N, 3, 3): its `focal_length`, if it takes one.

    Raises:
        ValueError: it takes one focal length, and the cameras have several.
    """
    if camera is None or "focal_length" not in INTEGRATORS.parameters(name):
        return {}
    several = camera[..., 0, 0].flatten().tolist()
    if max(several) > 1.001 * min(several):
        raise ValueError(f"{name}: cameras of focal lengths {min(several):g} to {max(several):g} given, one is needed")
    return {"focal_length": several[0]}


INTEGRATORS: Registry[Integrator] = Registry(
    {
        "least_squares": "LeastSquares",
        "frankot_chellappa": "FrankotChellappa",
        "horn_brooks": "HornBrooks",
        "line_integral": "LineIntegral",
        "shapelets": "Shapelets",
        "alpha_surface": "AlphaSurface",
        "b_spline": "BSpline",
        "gaussian_kernels": "GaussianKernels",
        "partial_integrability": "PartialIntegrability",
        "spectral_path": "SpectralPath",
        "harker_oleary": "HarkerOLeary",
        "weighted_harker_oleary": "WeightedHarkerOLeary",
        "spectral_regularization": "SpectralRegularization",
        "tikhonov_regularization": "TikhonovRegularization",
        "weighted_least_squares": "WeightedLeastSquares",
        "total_variation": "TotalVariation",
        "l1": "L1",
        "huber": "Huber",
        "m_estimator": "MEstimator",
        "anisotropic_diffusion": "AnisotropicDiffusion",
        "edge_preserving": "EdgePreserving",
        "bilateral": "Bilateral",
        "mumford_shah": "MumfordShah",
        "piecewise": "Piecewise",
        "dls": "DLS",
        "slope_dls": "SlopeDLS",
    }
)

LEARNERS: Registry[Learner] = Registry(
    {
        "soup_dil": "SoupDIL",
        "k_svd": "KSVD",
        "fixed": "FixedDictionary",
        "dino_kat": "DinoKat",
        "unitary": "Unitary",
        "focuss": "Focuss",
    }
)

PHOTOMETRIC: Registry[Any] = Registry(
    {
        "woodham": "woodham",
        "low_rank": "low_rank_normals",
        "sparse": "sparse_normals",
        "bivariate": "bivariate_normals",
        "dlpi": "dlpi_normals",
        "dlnv": "dlnv_normals",
    }
)
