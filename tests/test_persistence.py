"""Integrators as plain data and as files: what comes back is what was kept, bit by bit."""

import json
import math
import struct
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

import torchdls
from tests.helpers import random_field
from torchdls import (
    DLS,
    INTEGRATORS,
    KSVD,
    LEARNERS,
    DinoKat,
    FixedDictionary,
    Huber,
    Integrator,
    LeastSquares,
    Patches,
    SlopeDLS,
    SoupDIL,
    TikhonovRegularization,
    WeightedLeastSquares,
)
from torchdls._options import plain

pytest.importorskip("safetensors", reason="files of integrators need safetensors")

# Options that are not the defaults; an integrator that is not listed is tried with another pixel size alone.
OTHER: dict[str, dict[str, Any]] = {
    "least_squares": {"tol": 1e-4, "max_iter": 40, "boundary": "dirichlet"},
    "frankot_chellappa": {"extension": "mirrored"},
    "horn_brooks": {"tol": 1e-3, "max_iter": 5000, "relaxation": 1.5},
    "harker_oleary": {"support": 5, "degree": 2},
    "spectral_regularization": {"modes": (6, 0.5), "basis": "polynomial", "support": 5},
    "tikhonov_regularization": {"lam": 0.2, "order": 1, "support": 5, "degree": 3},
    "weighted_least_squares": {"threshold": 2.0, "floor": 0.1, "tol": 1e-5, "max_iter": 100},
    "total_variation": {"smoothing": 0.4, "n_iter": 7, "solve_tol": 1e-4},
    "l1": {"smoothing": 0.4, "n_iter": 7, "tol": 1e-4},
    "huber": {"delta": 0.1, "n_iter": 7},
    "m_estimator": {"loss": "tukey", "scale": 0.4, "floor": 0.01, "n_iter": 4, "joint": True},
    "anisotropic_diffusion": {"beta": 0.2, "follow": "field", "n_iter": 4},
    "gaussian_kernels": {"sigma": 2.0, "lam": 0.1},
    "edge_preserving": {"lam": 0.5, "delta": 0.2, "n_iter": 4},
    "mumford_shah": {"indicators": 4, "kappa": 0.3, "width": 0.7, "floor": 0.01, "n_iter": 4},
    "bilateral": {"k": 3.0, "focal_length": 2.0, "n_iter": 4},
    "dls": {"patch_size": (4, 5), "stride": (2, 3), "n_atoms": 20, "lam": 0.4, "mu": 0.2, "n_iter": 3, "tol": 0.0},
    "slope_dls": {"patch_sizes": (4, 8), "tau": 1.0, "n_iter": 2, "sigma": 0.1, "robust": True, "guard": None},
}
SMALL: dict[str, Any] = {"patch_size": 4, "n_atoms": 16, "n_iter": 2, "tol": 0.0}


def trained() -> DLS:
    atoms = nn.Parameter(torch.eye(16) + 0.1 * random_field(16, 16, dtype=torch.float32))
    tensors = {"lam": nn.Parameter(torch.tensor(0.4)), "mu": nn.Parameter(torch.tensor([0.3])), "dictionary": atoms}
    return DLS(**SMALL, **tensors)


CASES: dict[str, Integrator] = {
    **{name: torchdls.build(name, **OTHER.get(name, {}), pixel_size=(0.5, 2.0)) for name in INTEGRATORS},
    "trained": trained(),
    "frozen": DLS(**SMALL, mu=nn.Parameter(torch.tensor(0.3), requires_grad=False)),
    "double": trained().double(),
    "double_cosines": DLS(**SMALL).double(),
    "tensor_lam": DLS(**SMALL, lam=torch.tensor(0.4, dtype=torch.float64)),
    "buffer_dictionary": DLS(**SMALL, dictionary=random_field(16, 20)),
    "huber_data": DLS(**SMALL, data_term=Huber(delta=0.2, n_iter=3)),
    "k_svd": DLS(**SMALL, learner=KSVD(n_nonzero=4)),
    "dino_kat": DLS(**SMALL, learner=DinoKat(2, patch_size=(4, 4))),
    "fixed": DLS(**SMALL, learner="fixed"),
    "slope_fast": SlopeDLS.fast(patch_sizes=(4, 8)),
    "slope_sigma": SlopeDLS(patch_sizes=(4, 8), n_iter=2, sigma=torch.tensor([0.1, 0.2], dtype=torch.float64)),
    "trained_tikhonov": TikhonovRegularization(lam=nn.Parameter(torch.tensor([0.1], dtype=torch.float64))),
}


def slopes() -> Tensor:
    return random_field(2, 2, 14, 16, seed=3)


@pytest.mark.parametrize("name", OTHER)
def test_no_other_option_is_a_default(name: str) -> None:
    defaults = INTEGRATORS.parameters(name)
    assert all(defaults[option] != value for option, value in OTHER[name].items())


@pytest.mark.parametrize("case", CASES)
def test_file_gives_the_same_integrator(case: str, tmp_path: Path) -> None:
    integrator, path = CASES[case], tmp_path / "kept.safetensors"
    torchdls.save(path, integrator)
    found = torchdls.load(path)
    assert type(found) is type(integrator)
    assert found.options() == integrator.options()
    assert repr(found) == repr(integrator)
    with torch.no_grad():
        assert torch.equal(found(slopes()), integrator(slopes()))
    state = found.state_dict()
    assert state.keys() == integrator.state_dict().keys()
    for key, tensor in integrator.state_dict().items():
        assert state[key].dtype == tensor.dtype
        assert torch.equal(state[key], tensor)
    parameters = {key: p.requires_grad for key, p in found.named_parameters()}
    assert parameters == {key: p.requires_grad for key, p in integrator.named_parameters()}
    assert [p.name for p in tmp_path.iterdir()] == ["kept.safetensors"]


@pytest.mark.parametrize("name", INTEGRATORS)
@pytest.mark.parametrize("other", [False, True])
def test_options_build_it_again(name: str, other: bool) -> None:
    integrator = CASES[name] if other else INTEGRATORS[name]()
    options = integrator.options()
    assert list(options) == list(INTEGRATORS.parameters(name))
    again = torchdls.build(name, **json.loads(json.dumps(options)))  # plain data survive a text file
    assert again.options() == options
    assert repr(again) == repr(integrator)
    given = {**OTHER.get(name, {}), "pixel_size": (0.5, 2.0)} if other else {}
    assert {option: options[option] for option in given} == given


def test_parts_are_named_dicts() -> None:
    model = DLS(learner=KSVD(n_nonzero=4), data_term=Huber(delta=0.1))
    options = model.options()
    assert options["learner"] == {"name": "k_svd", "n_nonzero": 4, "steps": 1, "bound": math.inf, "tol": 0.0}
    assert options["data_term"] == {"name": "huber", **Huber(delta=0.1).options()}
    short = torchdls.build("dls", learner={"name": "k_svd", "n_nonzero": 4}, data_term={"name": "huber", "delta": 0.1})
    assert short.options() == options
    assert torchdls.build("dls", learner=KSVD(4), data_term=Huber(0.1)).options() == options


@pytest.mark.parametrize("name", LEARNERS)
def test_every_learner_is_a_part(name: str) -> None:
    options = DLS(learner=LEARNERS[name]()).options()
    assert options["learner"]["name"] == name
    assert torchdls.build("dls", **options).options() == options


def test_a_public_dataclass_is_a_part() -> None:
    """As the objects are that an option may hold beside the registered ones."""
    assert plain(Patches(4, 2)) == {"name": "Patches", "size": (4, 4), "stride": (2, 2), "wrap": False}
    with pytest.raises(ValueError, match="size: 0 given"):
        torchdls.build("dls", learner={"name": "Patches", "size": 0})
    with pytest.raises(ValueError, match="learner: 'select' is unknown"):
        torchdls.build("dls", learner={"name": "select"})


def test_names_of_integrators_and_parts_differ() -> None:
    assert not set(INTEGRATORS) & set(LEARNERS)


def test_tensors_are_marked_and_not_listed() -> None:
    options = CASES["trained"].options()
    assert options["dictionary"] == {"tensor": (16, 16), "dtype": "float32", "kind": "parameter"}
    assert options["lam"] == {"tensor": (), "dtype": "float32", "kind": "parameter"}
    assert CASES["buffer_dictionary"].options()["dictionary"]["kind"] == "buffer"
    with pytest.raises(ValueError, match=r"dictionary: this is the mark of a tensor.*use `load`"):
        torchdls.build("dls", dictionary=options["dictionary"])
    dictionary = CASES["trained"].dictionary
    model = torchdls.build("dls", **CASES["tensor_lam"].options() | {"lam": 0.3, "dictionary": dictionary})
    assert model.dictionary is dictionary


def test_options_follow_the_module() -> None:
    model = DLS(**SMALL, lam=nn.Parameter(torch.tensor(0.4)))
    model.n_iter = 5
    model.double()
    assert model.options()["n_iter"] == 5
    assert model.options()["lam"]["dtype"] == "float64"


@pytest.mark.parametrize(
    "integrator, text",
    [
        (LeastSquares(), "LeastSquares()"),
        (LeastSquares(1e-4, pixel_size=2), "LeastSquares(tol=0.0001, pixel_size=(2.0, 2.0))"),
        (DLS(), "DLS()"),
        (DLS(lam=torch.tensor(0.25)), "DLS(lam=Tensor(0.25))"),
        (
            DLS(4, n_atoms=20, dictionary=nn.Parameter(torch.ones(16, 20)), data_term=Huber(0.1)),
            "DLS(patch_size=(4, 4), n_atoms=20, data_term=Huber(delta=0.1), dictionary=Parameter(16x20))",
        ),
        (SlopeDLS(robust=True), "SlopeDLS(robust=True)"),
    ],
)
def test_repr_shows_what_differs_from_the_defaults(integrator: Integrator, text: str) -> None:
    assert repr(integrator) == text


@pytest.mark.parametrize("name", INTEGRATORS)
def test_repr_is_the_call_that_makes_it(name: str) -> None:
    assert repr(INTEGRATORS[name]()) == f"{INTEGRATORS[name].__name__}()"
    integrator = CASES[name]
    assert eval(repr(integrator), vars(torchdls) | {"__builtins__": {}}, _Public()).options() == integrator.options()


class _Public(dict[str, Any]):
    def __missing__(self, key: str) -> Any:
        return getattr(torchdls, key)


@pytest.mark.parametrize(
    "name, options, message",
    [
        ("magic", {}, "'magic' is unknown; choose from least_squares, "),
        ("k_svd", {}, "'k_svd' is unknown; choose from least_squares, "),
        ("dls", {"order_of_magic": 1, "magic": 2}, "dls: no option magic, order_of_magic; it has patch_size, stride, "),
        ("dls", {"learner": {"name": "magic"}}, "'magic' is unknown; choose from least_squares, .*dino_kat"),
        ("dls", {"learner": {"name": "k_svd", "magic": 1}}, "k_svd: no option magic; it has n_nonzero, steps"),
        ("dls", {"learner": {"n_nonzero": 1}}, "learner: a dict without 'name'"),
        ("dls", {"n_iter": -1}, "n_iter=-1"),
    ],
)
def test_build_says_what_it_knows(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        torchdls.build(name, **options)


def written(path: Path, metadata: dict[str, str] | None, tensors: dict[str, Tensor]) -> Path:
    import safetensors.torch

    safetensors.torch.save_file(tensors, path, metadata)
    return path


def contents(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors, read by the format's own definition: 8 bytes of length, JSON, the numbers."""
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__")
    tensors = {}
    for key, entry in header.items():
        assert entry["dtype"] == "F32"
        begin, end = (8 + length + offset for offset in entry["data_offsets"])
        tensors[key] = torch.frombuffer(bytearray(data[begin:end]), dtype=torch.float32).reshape(entry["shape"])
    return metadata, tensors


def test_file_is_open_to_other_readers(tmp_path: Path) -> None:
    path, model = tmp_path / "dls.safetensors", trained()
    torchdls.save(path, model)
    metadata, tensors = contents(path)
    assert metadata["format"] == "torchdls.integrator"
    assert metadata["version"] == "1"
    assert metadata["torchdls"] == torchdls.__version__
    assert json.loads(metadata["integrator"])["name"] == "dls"
    assert json.loads(metadata["integrator"])["options"]["patch_size"] == [4, 4]
    assert torch.equal(tensors["dictionary"], model.dictionary)
    assert set(tensors) == {"lam", "mu", "dictionary"}


def changed(name: str, **options: Any) -> str:
    return json.dumps({"name": name, "options": options})


@pytest.mark.parametrize(
    "change, message",
    [
        ({"format": "other"}, "holds no integrator of torchdls"),
        ({"version": "2"}, "has version '2' of the format, this torchdls reads up to 1"),
        ({"version": "one"}, "has version 'one'"),
        ({"integrator": "{"}, "cannot be read as an integrator"),
        ({"integrator": changed("magic")}, "'magic' is unknown; choose from least_squares"),
        ({"integrator": changed("dls", magic=1)}, "dls: no option magic"),
        ({"integrator": changed("least_squares")}, "holds tensors that the integrator has not: dictionary, lam, mu"),
        ({"integrator": changed("dls")}, "holds tensors that the integrator has not: lam, mu"),
        ({"integrator": changed("dls", n_iter=-1)}, "n_iter=-1"),
    ],
)
def test_load_says_what_it_does_not_know(change: dict[str, str], message: str, tmp_path: Path) -> None:
    torchdls.save(tmp_path / "good.safetensors", trained())
    metadata, tensors = contents(tmp_path / "good.safetensors")
    path = written(tmp_path / "bad.safetensors", metadata | change, tensors)
    with pytest.raises(ValueError, match=rf"bad\.safetensors.*{message}"):
        torchdls.load(path)


def test_load_says_which_tensors_are_wrong(tmp_path: Path) -> None:
    torchdls.save(tmp_path / "good.safetensors", trained())
    metadata, tensors = contents(tmp_path / "good.safetensors")
    path = tmp_path / "bad.safetensors"
    for change, message in [
        ({k: t for k, t in tensors.items() if k != "lam"}, "lacks the tensors lam"),
        (tensors | {"magic": torch.ones(3)}, "holds tensors that the integrator has not: magic"),
        (tensors | {"dictionary": torch.ones(3)}, "dictionary"),
    ]:
        with pytest.raises(ValueError, match=rf"bad\.safetensors.*{message}"):
            torchdls.load(written(path, metadata, change))
    torchdls.save(tmp_path / "plain.safetensors", DLS(**SMALL))
    metadata, tensors = contents(tmp_path / "plain.safetensors")
    with pytest.raises(ValueError, match="lacks the tensors dictionary"):
        torchdls.load(written(path, metadata, {}))
    with pytest.raises(ValueError, match=r"dictionary: shape \(16, 9\) given, \(16, 16\) is needed"):
        torchdls.load(written(path, metadata, {"dictionary": torch.ones(16, 9)}))


def test_load_refuses_other_files(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    with pytest.raises(FileNotFoundError):
        torchdls.load(path)
    path.write_bytes(b"not a safetensors file")
    with pytest.raises(ValueError, match=r"a\.safetensors: cannot be read as safetensors"):
        torchdls.load(path)
    with pytest.raises(ValueError, match=r"a\.safetensors: holds no integrator of torchdls"):
        torchdls.load(written(path, None, {"x": torch.ones(2)}))
    torchdls.save(path, trained(), overwrite=True)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"a\.safetensors: cannot be read as safetensors"):
        torchdls.load(path)


def test_save_replaces_a_file_only_if_asked(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    torchdls.save(path, DLS(**SMALL))
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        torchdls.save(path, LeastSquares())
    assert path.read_bytes() == before
    torchdls.save(path, LeastSquares(tol=1e-3), overwrite=True)
    assert repr(torchdls.load(path)) == "LeastSquares(tol=0.001)"
    with pytest.raises(ValueError, match=r"unknown format '\.pt', choose from \.safetensors"):
        torchdls.save(tmp_path / "a.pt", LeastSquares())
    with pytest.raises(FileNotFoundError):
        torchdls.save(tmp_path / "missing" / "a.safetensors", LeastSquares())


def test_what_has_no_name_is_not_kept(tmp_path: Path) -> None:
    class Own(LeastSquares):
        """A method of one's own."""

    path = tmp_path / "a.safetensors"
    assert Own(tol=1e-3).options() == LeastSquares(tol=1e-3).options()
    with pytest.raises(ValueError, match="Own is not one of least_squares, "):
        torchdls.save(path, Own())
    own_learner = DLS(learner=lambda *args, **kwargs: SoupDIL()(*args, **kwargs))
    assert repr(own_learner).startswith("DLS(learner=<function")
    for model in (DLS(data_term=Own()), own_learner):
        with pytest.raises(TypeError, match="has no form as plain data"):
            torchdls.save(path, model)
    assert not path.exists()


def test_parametrised_modules_show_but_are_not_kept(tmp_path: Path) -> None:
    """Their tensors are functions of others, which the constructor does not take."""
    model = DLS(**SMALL, lam=nn.Parameter(torch.tensor(0.25)))
    parametrize.register_parametrization(model, "lam", nn.Softplus())
    assert repr(model) == "DLS(patch_size=(4, 4), n_atoms=16, lam=Tensor(0.825939), n_iter=2, tol=0.0)"
    with pytest.raises(ValueError, match="ParametrizedDLS is not one of least_squares, "):
        torchdls.save(tmp_path / "a.safetensors", model)
    parametrize.remove_parametrizations(model, "lam")
    torchdls.save(tmp_path / "a.safetensors", model)
    assert torch.equal(torchdls.load(tmp_path / "a.safetensors").get_parameter("lam"), model.lam)


def test_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.safetensors"
    torchdls.save(path, LeastSquares())
    for name in ("safetensors", "safetensors.torch"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"pip install 'torchdls\[files\]'"):
        torchdls.load(path)
    with pytest.raises(ImportError, match=r"pip install 'torchdls\[files\]'"):
        torchdls.save(tmp_path / "b.safetensors", LeastSquares())
    assert not (tmp_path / "b.safetensors").exists()


def test_fixed_dictionary_and_trusts_round_trip() -> None:
    model = DLS(learner=FixedDictionary(), data_term=WeightedLeastSquares(threshold=2.0))
    assert repr(torchdls.build("dls", **model.options())) == repr(model)


def test_options_that_are_objects_come_back(tmp_path: Path) -> None:
    model = DLS(
        mu=[0.3, 0.2], n_iter=2, learner=FixedDictionary("soft", bound=2.0), height_step=torchdls.Proximal(5, True),
        derivative=torchdls.Implicit(1e-5),
    )  # fmt: skip
    again = torchdls.build("dls", **json.loads(json.dumps(model.options())))
    torchdls.save(tmp_path / "dls.safetensors", model)
    g = random_field(1, 2, 16, 16)
    for other in (again, torchdls.load(tmp_path / "dls.safetensors")):
        assert repr(other) == repr(model)
        assert torch.equal(other(g), model(g))
