"""A module is what its state says: each entry of each module's state, changed in each way.

After a change the tip, the Jacobian, the domain, the compiled core, the description that files and
exported code are written from, and a saved and loaded model are those of a module that is newly
constructed with the same state. Derivatives by the state are those of differences.
"""

import copy
import pickle
import threading
import warnings

import numpy as np
import pytest
import torch
from mechanical_models import CHAINS
from saved_models import FOLDER, models, tendon_chain
from torch.autograd import forward_ad
from torch.func import functional_call, jacfwd, jacrev, vmap

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ForceTendonChain,
    HybridForwardModel,
    PlayOperator,
    PrandtlIshlinskiiOperator,
    RigidChain,
    load_model,
    native,
    save_model,
)
from hybridkin._core.stored import KINDS_OF_MODELS
from hybridkin.hybrid.description import restorer
from hybridkin.learning.regressor_modules import KernelModule, PolynomialModule
from hybridkin.saving._file import packed, unpacked

FORCES = np.linspace(0.1, 0.5, 9).reshape(3, 3)
POWERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 1], [0, 1, 3], [2, 0, 1]]


def smooth():
    rng = np.random.default_rng(0)
    range_of = [0.2, 0.25, 0.3], [0.1, 0.12, 0.2]
    polynomial = PolynomialModule(POWERS, rng.normal(size=(6, 2)), *range_of)
    kernel = KernelModule(rng.normal(size=(7, 3)), rng.normal(size=(7, 2)), 0.1, *range_of)
    q = rng.uniform(0.2, 0.3, (3, 3))
    return {"polynomial": (polynomial, q), "kernel": (kernel, q)}


def all_models():
    """Return modules of all kinds, with rows of q."""
    force = ForceTendonChain([0.01], [0.1], 0.02, 200.0, weight=0.5, taper=0.3, arcs=3)
    found = {**CHAINS, **smooth(), "force": (force, FORCES)}
    for name, (model, q) in models().items():
        module = getattr(model, "module_", model)
        found.setdefault(f"saved {name}", (module, q[:3]))
    return found


@pytest.fixture(scope="module")
def modules():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return all_models()


SMALL = [*CHAINS, "polynomial", "kernel", "force"]
SAVED = [f"saved {path.stem}" for path in sorted(FOLDER.glob("*.safetensors"))]
NAMES = [*SMALL, *(pytest.param(name, marks=pytest.mark.slow) for name in SAVED)]


def changed(name, entry, rng):
    """Return another valid value of an entry: poses stay rigid, powers whole."""
    if entry.shape[-2:] == (4, 4) and name.endswith(("base", "tip", "origins", "motion")):
        motion = torch.eye(4, dtype=entry.dtype)
        motion[:3] = torch.tensor([[0.8, -0.6, 0, 0.01], [0.6, 0.8, 0, 0.02], [0, 0, 1, -0.03]])
        return entry @ motion
    if name.endswith("powers"):
        return entry.flip(1)
    relative = torch.from_numpy(rng.uniform(-0.03, 0.0, entry.shape)).to(entry)
    return torch.where(entry == 0.0, 1e-4 * (1.0 + relative), entry * (1.0 + relative))


def owner(module, name):
    """Return the module that has an entry of the state, and the entry's name there."""
    path, _, last = name.rpartition(".")
    return module.get_submodule(path), last


def loaded(module, name, value):
    module.load_state_dict({**module.state_dict(), name: value})


def assigned(module, name, value):
    module.load_state_dict({**module.state_dict(), name: value.clone()}, assign=True)


def in_place(module, name, value):
    part, last = owner(module, name)
    with torch.no_grad():
        getattr(part, last).copy_(value)


def by_data(module, name, value):
    part, last = owner(module, name)
    getattr(part, last).data.copy_(value)


def other_data(module, name, value):
    part, last = owner(module, name)
    getattr(part, last).data = value.clone()


def by_numpy(module, name, value):
    part, last = owner(module, name)
    getattr(part, last).numpy()[...] = value.numpy()


def replaced(module, name, value):
    part, last = owner(module, name)
    setattr(part, last, value.clone())


def as_parameter(module, name, value):
    part, last = owner(module, name)
    setattr(part, last, torch.nn.Parameter(value.clone()))


def learned(module, name, value):
    """Take the step of an optimizer from a state that requires a gradient."""
    part, last = owner(module, name)
    entry = getattr(part, last).requires_grad_()
    entry.grad = entry.detach() - value
    torch.optim.SGD([entry], lr=1.0).step()


WAYS = [loaded, assigned, in_place, by_data, other_data, by_numpy, replaced, as_parameter, learned]


def answers(module, q):
    """Return what a module computes in every way, by name."""
    rows = torch.from_numpy(q)
    x, J = module.forward_and_jacobian(rows)
    found = {"x": module(rows), "x with J": x, "J": J, "J alone": module.jacobian(rows)}
    found["distance"] = module.domain_distance(rows)
    if module.has_pose:
        found["pose"] = module.pose(rows)
    found = {name: a.detach().numpy() for name, a in found.items()}
    kinds = ["core x", "core J"]
    found |= dict(zip(kinds, native.evaluate(module, q, jacobian=True), strict=True))
    found |= {"one row": native.evaluate(module, q[:1])[0]}
    return found


def agree(found, expected, tol):
    assert {*found} == {*expected}
    for name, a in expected.items():
        size = max(1.0, np.abs(a).max())
        np.testing.assert_allclose(found[name], a, rtol=0, atol=tol * size, err_msg=name)


def newly_constructed(module):
    """Return the module that the constructors make of the state of a module."""
    return restorer()(unpacked(*packed(module.stored())))


def twin_with(module, name, value):
    """Return a module with another state, newly constructed."""
    twin = copy.deepcopy(module)
    part, last = owner(twin, name)
    part._buffers[last] = value
    for same, _ in list(twin.named_modules(remove_duplicate=False)):
        assert same is not module
    return newly_constructed(twin)


def tolerance(module):
    single = any(entry.dtype == torch.float32 for entry in module.state_dict().values())
    return 1e-4 if single else 1e-10


def test_the_table_holds_every_kind(modules):
    kinds = {"drift", "list"}
    for module, _ in modules.values():
        kinds |= {part.layout.kind for part in module.modules() if hasattr(part, "layout")}
    table = {"linear_features", "hidden_features", "markers_module"}  # in larger models
    assert {*KINDS_OF_MODELS} - kinds <= table | {"with_markers", "blend", "tip_hybrids"}


@pytest.mark.parametrize("kind", NAMES)
def test_every_entry_of_the_state_changes_the_module(modules, kind, tmp_path):
    module, q = modules[kind]
    rng = np.random.default_rng(0)
    tol = tolerance(module)
    for name, entry in module.state_dict().items():
        value = changed(name, entry, rng)
        expected = answers(twin_with(module, name, value), q)
        for way in WAYS:
            if way is by_numpy and not owner(module, name)[0]._buffers:
                continue
            twin = copy.deepcopy(module)
            agree(answers(twin, q), answers(module, q), tol)
            way(twin, name, value)
            try:
                agree(answers(twin, q), expected, tol)
                agree(answers(copy.deepcopy(twin), q), expected, tol)
                agree(answers(newly_constructed(twin), q), expected, tol)
            except AssertionError as error:
                raise AssertionError(f"{name} {way.__name__}: {error}") from None
        given = functional_call(module, {name: value}, (torch.from_numpy(q),))
        agree({"x": given.numpy()}, {"x": expected["x"]}, tol)
