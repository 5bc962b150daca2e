"""Surfaces from gradients in PyTorch: DLS and its peers, batched and differentiable.

Every public name imports from here. Names load their module on first use, so that ``import torchdls`` and
``torchdls --help`` answer at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see; a test keeps it equal to the table below
    from torchdls.dictionary import KSVD as KSVD
    from torchdls.dictionary import LEARNERS as LEARNERS
    from torchdls.dictionary import DinoKat as DinoKat
    from torchdls.dictionary import FixedDictionary as FixedDictionary
    from torchdls.dictionary import Learner as Learner
    from torchdls.dictionary import SoupDIL as SoupDIL
    from torchdls.dictionary import Unitary as Unitary
    from torchdls.dictionary import dct_dictionary as dct_dictionary
    from torchdls.dictionary import orthogonal_matching_pursuit as orthogonal_matching_pursuit
    from torchdls.dictionary import soup_dil_sweep as soup_dil_sweep
    from torchdls.geometry import GradientField as GradientField
    from torchdls.geometry import GradientToNormals as GradientToNormals
    from torchdls.geometry import NormalsToGradient as NormalsToGradient
    from torchdls.geometry import convert_gradient as convert_gradient
    from torchdls.geometry import convert_normals as convert_normals
    from torchdls.geometry import depth_to_points as depth_to_points
    from torchdls.geometry import gradient_to_normals as gradient_to_normals
    from torchdls.geometry import guess_convention as guess_convention
    from torchdls.geometry import height_to_points as height_to_points
    from torchdls.geometry import log_depth_to_depth as log_depth_to_depth
    from torchdls.geometry import normals_to_gradient as normals_to_gradient
    from torchdls.integrators import DLS as DLS
    from torchdls.integrators import INTEGRATORS as INTEGRATORS
    from torchdls.integrators import L1 as L1
    from torchdls.integrators import AnisotropicDiffusion as AnisotropicDiffusion
    from torchdls.integrators import Bilateral as Bilateral
    from torchdls.integrators import DLSResult as DLSResult
    from torchdls.integrators import FrankotChellappa as FrankotChellappa
    from torchdls.integrators import HarkerOLeary as HarkerOLeary
    from torchdls.integrators import HornBrooks as HornBrooks
    from torchdls.integrators import Huber as Huber
    from torchdls.integrators import Integrator as Integrator
    from torchdls.integrators import LeastSquares as LeastSquares
    from torchdls.integrators import LineIntegral as LineIntegral
    from torchdls.integrators import MEstimator as MEstimator
    from torchdls.integrators import MumfordShah as MumfordShah
    from torchdls.integrators import RobustResult as RobustResult
    from torchdls.integrators import SlopeDLS as SlopeDLS
    from torchdls.integrators import SlopeDLSResult as SlopeDLSResult
    from torchdls.integrators import SpectralRegularization as SpectralRegularization
    from torchdls.integrators import TikhonovRegularization as TikhonovRegularization
    from torchdls.integrators import TotalVariation as TotalVariation
    from torchdls.integrators import WeightedLeastSquares as WeightedLeastSquares
    from torchdls.integrators import dls_objective as dls_objective
    from torchdls.io import load_camera as load_camera
    from torchdls.io import load_field as load_field
    from torchdls.io import load_height as load_height
    from torchdls.io import load_mask as load_mask
    from torchdls.io import save_height as save_height
    from torchdls.io import save_mesh as save_mesh
    from torchdls.metrics import mean_absolute_depth_error as mean_absolute_depth_error
    from torchdls.metrics import mean_angular_error as mean_angular_error
    from torchdls.metrics import rmse as rmse
    from torchdls.metrics import ssim as ssim
    from torchdls.noise import add_noise as add_noise
    from torchdls.noise import noise_level as noise_level
    from torchdls.noise import noise_sigma as noise_sigma
    from torchdls.operators import GradientOperator as GradientOperator
    from torchdls.operators import Patches as Patches
    from torchdls.operators import dct2 as dct2
    from torchdls.operators import edge_slopes as edge_slopes
    from torchdls.operators import idct2 as idct2
    from torchdls.photometric import PhotometricResult as PhotometricResult
    from torchdls.photometric import cast_shadows as cast_shadows
    from torchdls.photometric import low_rank_normals as low_rank_normals
    from torchdls.photometric import render as render
    from torchdls.photometric import ring_of_lights as ring_of_lights
    from torchdls.photometric import sparse_normals as sparse_normals
    from torchdls.photometric import woodham as woodham
    from torchdls.plot import compare_heights as compare_heights
    from torchdls.plot import hillshade as hillshade
    from torchdls.plot import page_html as page_html
    from torchdls.plot import surface_page as surface_page
    from torchdls.selection import Selection as Selection
    from torchdls.selection import select as select
    from torchdls.solvers import ConvergenceWarning as ConvergenceWarning
    from torchdls.solvers import SolveResult as SolveResult
    from torchdls.solvers import solve as solve
    from torchdls.surfaces import SURFACES as SURFACES
    from torchdls.surfaces import Surface as Surface
    from torchdls.surfaces import terrain as terrain

__version__ = "0.1.0"

_MODULE_OF = {
    # integrators
    "DLS": "integrators",
    "DLSResult": "integrators",
    "INTEGRATORS": "integrators",
    "Integrator": "integrators",
    "LeastSquares": "integrators",
    "FrankotChellappa": "integrators",
    "HarkerOLeary": "integrators",
    "HornBrooks": "integrators",
    "LineIntegral": "integrators",
    "SlopeDLS": "integrators",
    "SlopeDLSResult": "integrators",
    "SpectralRegularization": "integrators",
    "TikhonovRegularization": "integrators",
    "dls_objective": "integrators",
    "Huber": "integrators",
    "L1": "integrators",
    "MEstimator": "integrators",
    "AnisotropicDiffusion": "integrators",
    "Bilateral": "integrators",
    "MumfordShah": "integrators",
    "RobustResult": "integrators",
    "TotalVariation": "integrators",
    "WeightedLeastSquares": "integrators",
    # the parts they are made of
    "GradientOperator": "operators",
    "Patches": "operators",
    "dct2": "operators",
    "edge_slopes": "operators",
    "idct2": "operators",
    "ConvergenceWarning": "solvers",
    "SolveResult": "solvers",
    "solve": "solvers",
    "dct_dictionary": "dictionary",
    "KSVD": "dictionary",
    "LEARNERS": "dictionary",
    "DinoKat": "dictionary",
    "FixedDictionary": "dictionary",
    "Learner": "dictionary",
    "SoupDIL": "dictionary",
    "Unitary": "dictionary",
    "orthogonal_matching_pursuit": "dictionary",
    "soup_dil_sweep": "dictionary",
    # normals, gradients, cameras
    "GradientField": "geometry",
    "GradientToNormals": "geometry",
    "NormalsToGradient": "geometry",
    "convert_gradient": "geometry",
    "convert_normals": "geometry",
    "depth_to_points": "geometry",
    "gradient_to_normals": "geometry",
    "guess_convention": "geometry",
    "height_to_points": "geometry",
    "log_depth_to_depth": "geometry",
    "normals_to_gradient": "geometry",
    # images to normals
    "PhotometricResult": "photometric",
    "cast_shadows": "photometric",
    "low_rank_normals": "photometric",
    "render": "photometric",
    "ring_of_lights": "photometric",
    "sparse_normals": "photometric",
    "woodham": "photometric",
    # files and pictures
    "load_camera": "io",
    "load_field": "io",
    "load_height": "io",
    "load_mask": "io",
    "save_height": "io",
    "save_mesh": "io",
    "compare_heights": "plot",
    "hillshade": "plot",
    "page_html": "plot",
    "surface_page": "plot",
    # data and measures
    "SURFACES": "surfaces",
    "Surface": "surfaces",
    "add_noise": "noise",
    "noise_sigma": "noise",
    "terrain": "surfaces",
    "mean_absolute_depth_error": "metrics",
    "mean_angular_error": "metrics",
    "rmse": "metrics",
    "ssim": "metrics",
    "noise_level": "noise",
    "Selection": "selection",
    "select": "selection",
}

__all__ = ["__version__", *_MODULE_OF]


if not TYPE_CHECKING:  # else every misspelt name would pass the type checker as Any

    def __getattr__(name: str) -> Any:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        globals()[name] = value  # the next use does not come here
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF})
