"""Every public function refuses other tensors than it takes: a TypeError for the dtype, a ValueError for the shape.

The arguments are found from the signatures, so a new public function must say here how it is called.
"""

import inspect
import itertools

import pytest
import torch
from torch import Tensor

import torchdls
from tests.helpers import random_field, uniform_field

H, W, LIGHTS = 16, 18, 5


def field(channels, dtype=torch.float32):
    return uniform_field(1, channels, H, W, dtype=dtype) + 0.5


def mask():
    return torch.ones(1, 1, H, W, dtype=torch.bool)


def camera():
    return torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])


def lights():
    return torchdls.ring_of_lights(LIGHTS)


def patches():
    return {"P": random_field(1, 16, 9, dtype=torch.float32), "D": torchdls.dct_dictionary(4)[None]}


PHOTOMETRIC = {"images": field(LIGHTS), "lights": lights(), "mask": mask(), "lit": mask().expand(-1, LIGHTS, -1, -1)}
MEASURED = {"height": field(1), "reference": field(1), "mask": mask()}
NORMALS = {"normals": field(3), "mask": mask(), "camera": camera()}
OPERATOR, PATCHES = torchdls.GradientOperator(), torchdls.Patches(4, 2)

# How each is called; the tensors among these arguments are what is replaced. Public functions are called by name.
CALLS = {
    "add_noise": {"gradient": field(2), "snr_db": 10.0, "mask": mask()},
    "backends": {},
    "bivariate_normals": PHOTOMETRIC | {"n_iter": 2},
    "cast_shadows": {"height": field(1), "lights": lights()},
    "compare_heights": {"truth": field(1), "heights": {"height": field(1)}, "mask": mask(), "gradient": field(2),
                        "measured": field(2)},
    "convert_gradient": {"gradient": field(2)},
    "convert_normals": {"normals": field(3)},
    "dct2": {"x": field(1)},
    "dct_dictionary": {},
    "denoise_normals": NORMALS | {"sigma": torch.ones(1)},
    "denoise_height": {"height": field(1), "sigma": 0.1, "patch_size": 4, "n_passes": 1},
    "depth_to_points": {"depth": field(1), "camera": camera()},
    "dlnv_normals": PHOTOMETRIC | {"n_iter": 1},
    "dlpi_normals": PHOTOMETRIC | {"n_iter": 1},
    "edge_slopes": {"gradient": field(2), "mask": mask(), "weight": field(1), "error": torch.ones(1, 1, 1, 1)},
    "fit_coarse": {"height": field(1), "coarse": field(1), "mask": mask(), "pieces": mask().long()},
    "fit_mesh": {"vertices": torch.rand(3, 3), "faces": torch.tensor([[0, 1, 2]]), "normals": torch.ones(1, 3)},
    "gradient_to_normals": {"gradient": field(2), "camera": camera()},
    "guess_convention": NORMALS,
    "height_to_points": {"height": field(1)},
    "hillshade": {"height": field(1)},
    "idct2": {"x": field(1)},
    "integrate_scattered": {"points": torch.rand(9, 2), "slopes": torch.rand(9, 2), "at": torch.rand(4, 2)},
    "lights_from_ball": {"images": torch.rand(LIGHTS, H, W), "ball": mask()[0]},
    "log_depth_to_depth": {"log_depth": field(1), "scale": torch.ones(1, 1, 1, 1)},
    "low_rank_normals": PHOTOMETRIC,
    "mean_absolute_depth_error": {"depth": field(1), "reference": field(1), "mask": mask()},
    "mean_angular_error": MEASURED,
    "noise_level": {"gradient": field(2), "mask": mask(), "weight": field(1)},
    "noise_sigma": {"gradient": field(2), "snr_db": 10.0, "mask": mask()},
    "normal_noise": NORMALS,
    "normals_to_gradient": NORMALS,
    "orthogonal_matching_pursuit": {**patches(), "mu": torch.ones(1, 1), "tol": torch.ones(1, 1)},
    "place_pieces": {"height": field(1), "pieces": mask().long(), "offsets": torch.ones(1, 1)},
    "reconstruct": NORMALS | {"method": "least_squares", "known": field(1), "coarse": field(1)},
    "refine": {"height": field(1), **PHOTOMETRIC, "albedo": field(1), "n_iter": 1},
    "render": {"normals": field(3), "lights": lights(), "albedo": field(1), "shadow": mask()},
    "ring_of_lights": {},
    "rmse": MEASURED,
    "save_height": {"height": field(1), "mask": mask(), "points": field(3)},
    "save_normals": {"normals": field(3), "mask": mask()},
    "save_mesh": {"points": field(3), "mask": mask()},
    "select": {"integrate": torchdls.LeastSquares(), "gradient": field(2), "candidates": 1, "noise": torch.ones(1)},
    "shrink_slow_waves": {"height": field(1), "reference": field(1), "noise": torch.ones(1)},
    "slope_noise": {"normals": field(3), "covariance": field(6), "camera": camera()},
    "solve": {"v": field(2), "w": field(2), "anchor": field(1), "anchor_weight": field(1), "z0": field(1)},
    "soup_dil_sweep": {**patches(), "B": torch.zeros(1, 16, 9), "mu": torch.ones(16)},
    "sparse_normals": PHOTOMETRIC | {"n_iter": 2},
    "ssim": MEASURED | {"data_range": 1.0},
    "surface_page": {"heights": {"height": field(1)}, "mask": mask()},
    "surface_preview": {"height": field(1), "gradient": field(2), "truth": field(1), "mask": mask(), "trust": field(1),
                        "jump": field(2)},
    "terrain": {"n": 16},
    "woodham": PHOTOMETRIC,
}  # fmt: skip
METHODS = {
    "GradientOperator": (OPERATOR, {"z": field(1)}),
    "GradientOperator.adjoint": (OPERATOR.adjoint, {"g": field(2)}),
    "Patches.adjoint": (PATCHES.adjoint, {"x": PATCHES.extract(field(1)), "shape": (H, W)}),
    "Patches.coverage": (PATCHES.coverage, {"shape": (H, W), "dtype": torch.float32}),
    "Patches.extract": (PATCHES.extract, {"z": field(1)}),
    "Patches.extract_onto": (PATCHES.extract_onto, {"x": PATCHES.extract(field(1)), "z": field(1)}),
    "GradientToNormals": (torchdls.GradientToNormals(), {"gradient": field(2)}),
    "GradientToNormals(camera)": (torchdls.GradientToNormals, {"camera": camera()}),
    "NormalsToGradient": (torchdls.NormalsToGradient(), {"normals": field(3)}),
    "NormalsToGradient(camera)": (torchdls.NormalsToGradient, {"camera": camera()}),
    "SURFACES": (torchdls.SURFACES["tent"], {"n": 16, "dtype": torch.float32}),
}
# Arguments of no tensor, or tensors of any kind: pages, paths; and these take any number of dimensions from two on.
NO_TENSORS = {
    "build",
    "integrate_many",
    "load",
    "load_camera",
    "load_field",
    "load_height",
    "load_mask",
    "load_photographs",
    "page_html",
    "save",
}
ELSEWHERE = {"dls_objective"}  # checked by the fields of the integrators
ANY_BATCH = {("dct2", "x"), ("hillshade", "height"), ("idct2", "x")}
# What broadcasts, or is a whole list of fields; the shapes of cameras of modules are looked at beside their field.
ANY_SHAPE = {("log_depth_to_depth", "log_depth"), ("log_depth_to_depth", "scale")}
ANY_SHAPE |= {("GradientToNormals(camera)", "camera"), ("NormalsToGradient(camera)", "camera")}


def entry(name):
    if name in METHODS:
        return METHODS[name]
    return getattr(torchdls, name), CALLS[name]


def call(name, folder, **changed):
    function, arguments = entry(name)
    path = {"save_height": ("x.ply",), "save_mesh": ("x.ply",), "save_normals": ("x.npy",)}.get(name, ())
    first = [folder / p for p in path]
    return function(*first, **arguments | changed)


def tensors(name):
    """Argument -> its tensor, whether it stands alone or in a mapping of heights."""
    inner = {k: v["height"] if isinstance(v, dict) else v for k, v in entry(name)[1].items()}
    return {k: v for k, v in inner.items() if isinstance(v, Tensor)}


def replaced(name, argument, value):
    return {argument: {"height": value} if isinstance(entry(name)[1][argument], dict) else value}


ARGUMENTS = [(name, argument) for name in (*CALLS, *METHODS) for argument in tensors(name)]


def test_every_public_function_and_each_of_its_tensors_is_here():
    public = {name for name in torchdls.__all__ if inspect.isfunction(getattr(torchdls, name))}
    assert public == {*CALLS, *NO_TENSORS, *ELSEWHERE}
    for name in CALLS:
        parameters = inspect.signature(getattr(torchdls, name)).parameters.values()
        expected = {p.name for p in parameters if "Tensor" in str(p.annotation) and p.kind is not p.VAR_KEYWORD}
        assert {*tensors(name)} == {n for n in expected if "Callable" not in str(annotation(name, n))}, name


def annotation(name, argument):
    return inspect.signature(getattr(torchdls, name)).parameters[argument].annotation


@pytest.mark.parametrize("name", [*CALLS, *METHODS])
def test_the_call_itself_is_right(name, tmp_path):
    call(name, tmp_path)


@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.complex64], ids=str)
@pytest.mark.parametrize("name, argument", ARGUMENTS)
def test_a_wrong_dtype_is_a_type_error_that_names_the_argument(name, argument, dtype, tmp_path):
    wrong = tensors(name)[argument].to(dtype)
    if wrong.dtype == tensors(name)[argument].dtype:
        pytest.skip("the dtype it has")
    label = {("compare_heights", "truth"): "Ground truth"}.get((name, argument), argument)
    label = "height" if argument in ("heights", "depth", "log_depth") and name != "depth_to_points" else label
    with pytest.raises(TypeError, match=rf"{label}\b.*dtype {dtype}|{argument}\b.*dtype {dtype}"):
        call(name, tmp_path, **replaced(name, argument, wrong))


@pytest.mark.parametrize("name, argument", ARGUMENTS)
def test_a_mask_of_floats_and_a_field_of_bools_are_type_errors(name, argument, tmp_path):
    right = tensors(name)[argument]
    wrong = right.float() if right.dtype == torch.bool else right > 0
    with pytest.raises(TypeError, match=f"dtype {wrong.dtype}"):
        call(name, tmp_path, **replaced(name, argument, wrong))


@pytest.mark.parametrize("name, argument", ARGUMENTS)
def test_what_is_no_tensor_is_a_type_error(name, argument, tmp_path):
    if argument in ("scale", "albedo", "mu", "tol", "anchor_weight", "known"):
        pytest.skip("a number will do")
    wrong = tensors(name)[argument].tolist()
    with pytest.raises(TypeError, match="is a list"):
        call(name, tmp_path, **replaced(name, argument, wrong))


@pytest.mark.parametrize("name, argument", [a for a in ARGUMENTS if a not in ANY_SHAPE])
def test_a_wrong_shape_is_a_value_error(name, argument, tmp_path):
    right = tensors(name)[argument]
    shapes = [right.flatten()[: right.numel() - 1]]  # one dimension, and a number that fits nothing
    if (name, argument) not in ANY_BATCH:
        shapes.append(right[None, None, None])
    for wrong in shapes:
        with pytest.raises(ValueError, match=r"\(\d"):
            call(name, tmp_path, **replaced(name, argument, wrong))


@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.complex64], ids=str)
@pytest.mark.parametrize(
    "name", [n for n in (*CALLS, *METHODS) if "dtype" in inspect.signature(entry(n)[0]).parameters]
)
def test_a_dtype_asked_for_is_one_of_two(name, dtype, tmp_path):
    with pytest.raises(TypeError, match=f"dtype is {dtype}; torch.float32 or torch.float64"):
        call(name, tmp_path, dtype=dtype)


@pytest.mark.parametrize("name, of", list(itertools.product(torchdls.INTEGRATORS, ["gradient", "mask", "weight"])))
def test_integrators(name, of):
    integrator = torchdls.INTEGRATORS[name](**({"modes": 4} if name == "spectral_regularization" else {}))
    given = {"gradient": field(2), "mask": mask(), "weight": field(1)}
    given = {k: v for k, v in given.items() if k == "gradient" or k in integrator.accepts}
    if of not in given:
        pytest.skip(f"{name} takes no {of}")
    for dtype in (torch.int64, torch.float16, torch.complex64):
        with pytest.raises(TypeError, match=f"{of} has dtype {dtype}"):
            integrator(**given | {of: given[of].to(dtype)})
