"""A module is what its state says: each entry of each module's state, changed in each way.

After a change the tip, the Jacobian, the domain, the compiled core, the description that files and
exported code are written from, and a saved and loaded model are those of a module that is newly
constructed with the same state. Derivatives by the state are those of differences.
"""

import copy
import itertools
import os
import pickle
import sys
import threading

import numpy as np
import pytest
import torch
from mechanical_models import CHAINS
from operators import operators
from saved_models import models, structural_chain, tendon_chain, trunk, trunk_log
from torch.autograd import forward_ad
from torch.func import functional_call, jacfwd, jacrev, vmap
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    ForceTendonChain,
    HybridForwardModel,
    load_model,
    native,
    save_model,
)
from hybridkin._core.derived import derived
from hybridkin._core.stored import KINDS_OF_MODELS
from hybridkin.hybrid._features import PoseFeatures, Readout
from hybridkin.hybrid._module import HybridModule, InnerCorrection
from hybridkin.hybrid.description import restorer
from hybridkin.learning.regressor_modules import (
    AffineModule,
    KernelModule,
    RescaledModule,
)
from hybridkin.saving._file import packed, unpacked

IN_FULL = "EXAMPLES" in os.environ  # in the examination
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")

FORCES = np.linspace(0.1, 0.5, 3)[None]


def smooth():
    rng = np.random.default_rng(0)
    range_of = [0.2, 0.25, 0.3], [0.1, 0.12, 0.2]
    kernel = KernelModule(rng.normal(size=(7, 3)), rng.normal(size=(7, 2)), 0.1, *range_of)
    q = rng.uniform(0.2, 0.3, (3, 3))
    return {"kernel": (kernel, q)}


def rescaled():
    rng = np.random.default_rng(0)
    line = AffineModule(rng.normal(size=(2, 3)), rng.normal(size=2))
    mean, spread = torch.tensor([0.1, 0.2]).double(), torch.tensor(0.3).double()
    return RescaledModule(line, mean, spread), rng.uniform(0.2, 0.3, (3, 3))


def balanced():
    """A network that learned of balanced pairs of tendons, constant elsewhere."""
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.006, 0.005], lengths=[0.08, 0.07], n_actuators=2)
    pulls = rng.uniform(-0.004, 0.004, (30, 2))
    q = np.stack([pulls[:, 0], -pulls[:, 0], pulls[:, 1], -pulls[:, 1]], axis=1)
    x = chain(torch.from_numpy(q)).numpy() + 75.0 * q[:, :1] ** 2 * [1.0, 2.0, 3.0]
    return HybridForwardModel(chain, ELMRegressor(4, random_state=0)).fit(q, x).module_, q[:3]


def marked():
    """Two markers, each with its correction."""
    q, x, groups = trunk_log()
    chain = trunk().with_markers([(0, 0.5), (0, 1.0)])
    x = np.hstack([0.4 * x, x])
    return HybridForwardModel(chain, "linear").fit(q, x, groups=groups).module_, q[:3]


def structural_hybrid():
    """A correction by the poses of a robot, on top of errors of its structure."""
    chain = tendon_chain()
    _, q = CHAINS["tendons"]
    features = PoseFeatures.of_range(torch.from_numpy(q), chain)
    weights = 1e-3 * np.random.default_rng(0).normal(size=(6, 38))
    correction = InnerCorrection(Readout(features, torch.from_numpy(weights)))
    return HybridModule(structural_chain(chain), [correction], torch.ones(1).double()), q


def all_models():
    """Return modules of all kinds, with rows of q."""
    force = ForceTendonChain([0.01], [0.1], 0.02, 200.0, weight=0.5, taper=0.3, arcs=2)
    found = {**CHAINS, **smooth(), "force": (force, FORCES)}
    found |= {"balanced": balanced(), "two markers": marked(), "rescaled": rescaled()}
    found["structural hybrid"] = structural_hybrid()
    for name, (model, q) in models().items():
        module = getattr(model, "module_", model)
        found.setdefault(f"saved {name}", (module, q[:3]))
    return found


SMALL = ["trunk", "kernel"]  # the others are drawn from


def changed(name, entry, rng):
    """Return another valid value of an entry: poses stay rigid."""
    if entry.shape[-2:] == (4, 4) and name.endswith(("base", "tip", "origins", "motion")):
        motion = [[0.8, -0.6, 0, 0.01], [0.6, 0.8, 0, 0.02], [0, 0, 1, -0.03], [0, 0, 0, 1]]
        return entry @ torch.tensor(motion, dtype=entry.dtype)
    relative = torch.from_numpy(rng.uniform(-0.03, 0.0, entry.shape)).to(entry)
    return torch.where(entry == 0.0, 1e-4 * (1.0 + relative), entry * (1.0 + relative))


def owner(module, name):
    """Return the module that has an entry of the state, and the entry's name there."""
    path, _, last = name.rpartition(".")
    return module.get_submodule(path), last


def with_entry(module, name, value):
    """Return the state of a module with another entry, also where a part is shared."""
    state = module.state_dict()
    place = state[name].data_ptr()
    return {key: value.clone() if a.data_ptr() == place else a for key, a in state.items()}


def loaded(module, name, value):
    module.load_state_dict(with_entry(module, name, value))


def assigned(module, name, value):
    module.load_state_dict(with_entry(module, name, value), assign=True)


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
    change = entry.detach() - value
    entry.grad = torch.where(value.isfinite(), change, 0.0)  # no step makes a limit infinite
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
    twin = copy.deepcopy(module)  # which has computed nothing
    part, last = owner(twin, name)
    part._buffers[last] = value
    return newly_constructed(twin)


def tolerance(module):
    single = any(entry.dtype == torch.float32 for entry in module.state_dict().values())
    return 1e-4 if single else 1e-10


def check_entry(module, q, name, ways):
    """Check that a module with another entry is what a new one with that state is."""
    value = changed(name, module.state_dict()[name], np.random.default_rng(0))
    reference = twin_with(module, name, value)
    expected, tol = answers(reference, q), tolerance(module)
    for way in ways:
        twin = copy.deepcopy(module)
        twin.forward_and_jacobian(torch.from_numpy(q))  # which keeps what it computes
        native.evaluate(twin, q, jacobian=True)
        way(twin, name, value)
        try:
            agree(answers(twin, q), expected, tol)
            if way in (as_parameter, learned):
                agree(answers(pickle.loads(pickle.dumps(twin)), q), expected, tol)
            assert packed(twin.stored())[0] == packed(reference.stored())[0]
        except AssertionError as error:
            raise AssertionError(f"{name} {way.__name__}: {error}") from None
    twin = copy.deepcopy(module)  # entries of parts that share a tensor are its own there
    given = functional_call(twin, {name: value}, (torch.from_numpy(q),))
    agree({"x": given.numpy()}, {"x": expected["x"]}, tol)


@pytest.mark.parametrize("kind", SMALL)
def test_every_entry_changed_in_every_way(kind):
    module, q = {**CHAINS, **smooth()}[kind]
    for name in module.state_dict():
        check_entry(module, q, name, WAYS)


@pytest.mark.slow
def test_every_entry_of_every_module():
    """Each of a kind of part in a kind of model in one way; the examination tries all of them."""
    every = all_models()
    kinds, tested = set(), set()
    ways = itertools.cycle(WAYS)
    for key, (module, q) in every.items():
        kinds |= {part.layout.kind for part in module.modules() if hasattr(part, "layout")}
        for name in module.state_dict():
            part, last = owner(module, name)
            entry = type(module), type(part), last, key if IN_FULL else ""
            if IN_FULL or entry not in tested:
                check_entry(module, q[:2], name, WAYS if IN_FULL else [next(ways)])
            tested.add((*entry, name) if IN_FULL else entry)
    assert {*KINDS_OF_MODELS} <= kinds
    print(f"{len(tested)} entries of {len(every)} modules")  # noqa: T201, for the examination


TRUNK = ConstantCurvatureChain([0.02, 0.018])
LENGTHS = torch.from_numpy(np.random.default_rng(1).uniform(0.1, 0.12, (4, 6)))
OTHER = torch.tensor([0.03, 0.02]).double()


def test_other_radii_are_another_robot(tmp_path):
    """All keys match, so the module is the other robot, and so is its file."""
    chain, other = copy.deepcopy(TRUNK), ConstantCurvatureChain(OTHER)
    chain.load_state_dict({**chain.state_dict(), "radii": OTHER})
    save_model(chain, tmp_path / "model")
    for twin in (chain, load_model(tmp_path / "model")):
        assert_close(twin(LENGTHS), other(LENGTHS), rtol=0, atol=1e-14)
    assert (chain(LENGTHS) - TRUNK(LENGTHS)).norm(dim=1).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["trunk", "tendons", "pair", "rotation", "elastic", "arm"])
def test_derivatives_by_the_state_are_those_of_differences(kind):
    module, q = CHAINS[kind]
    rng = np.random.default_rng(0)
    rows = torch.from_numpy(q + 1e-4 * rng.normal(size=q.shape))  # no tendon is just taut
    for name, entry in module.state_dict().items():
        if name in ("q_min", "q_max", "dq_max", "ddq_max"):
            continue
        scale = float(entry.abs().max()) or 1e-2
        way = scale * torch.from_numpy(rng.normal(size=entry.shape))

        def tips(value, name=name):
            return functional_call(module, {name: value}, (rows,))

        steps = 1e-6 * way
        differences = (tips(entry + steps) - tips(entry - steps)) / 2e-6
        twin = copy.deepcopy(module)
        leaf = twin.get_buffer(name).requires_grad_()
        twin(rows)[..., 0].sum().backward()
        (along,) = jacfwd(lambda t, tips=tips, e=entry, w=way: tips(e + t * w))(torch.zeros(1))[
            None
        ]
        with forward_ad.dual_level():
            dual = tips(forward_ad.make_dual(entry, way))
            tangent = forward_ad.unpack_dual(dual).tangent
        tangent = torch.zeros_like(rows[:, :3]) if tangent is None else tangent
        by_batch = vmap(tips)(torch.stack([entry, entry + steps]))
        size = 1e-7 * max(1.0, float(differences.abs().max()))
        assert_close((leaf.grad * way).sum(), differences[..., 0].sum(), rtol=1e-6, atol=9 * size)
        assert_close((jacrev(tips)(entry) * way).flatten(2).sum(2), differences, rtol=0, atol=size)
        assert_close(along[..., 0], differences, rtol=0, atol=size)
        assert_close(tangent, differences, rtol=0, atol=size)
        assert_close(by_batch[1], tips(entry + steps), rtol=0, atol=1e-12)
        assert_close(module(rows), by_batch[0], rtol=0, atol=1e-12)


def test_an_optimizer_finds_the_geometry():
    chain = TRUNK.with_geometry(radii=torch.nn.Parameter(OTHER.clone()))
    assert [name for name, _ in chain.named_parameters()] == ["radii"]
    optimizer = torch.optim.LBFGS(chain.parameters(), line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        error = 1e3 * (chain(LENGTHS) - TRUNK(LENGTHS)).square().mean()
        error.backward()
        return error

    for _ in range(10):
        optimizer.step(loss)
    assert_close(chain.radii.detach(), TRUNK.radii, rtol=1e-4, atol=0)
    assert_close(chain(LENGTHS).detach(), TRUNK(LENGTHS), rtol=0, atol=1e-5)


def test_weights_of_corrections_have_derivatives():
    q, x, groups = trunk_log()
    for coupling in ("parallel", "serial"):
        model = HybridForwardModel(trunk(), "linear", coupling=coupling).fit(q, x, groups=groups)
        module, rows = model.module_, torch.from_numpy(q[:3])
        weights = {"weights": torch.ones(1).double().requires_grad_()}
        given = functional_call(module, weights, (rows,))
        (slope,) = torch.autograd.grad(given.sum(), weights["weights"])
        assert_close(slope[0], (module(rows) - module.mechanical(rows)).sum(), rtol=0, atol=1e-12)
        module.weights.mul_(1.05)  # of the core as of torch, also where they sum to more than one
        found = native.evaluate(module, q[:3], jacobian=True)
        for a, b in zip(found, module.forward_and_jacobian(rows), strict=True):
            np.testing.assert_allclose(a, b.numpy(), rtol=0, atol=1e-12)


def test_copies_keep_what_is_learned_and_frozen_models_have_none():
    chain = TRUNK.with_geometry(radii=torch.nn.Parameter(OTHER.clone()))
    chain.offsets.requires_grad_()
    for twin in (copy.deepcopy(chain), pickle.loads(pickle.dumps(chain)), copy.copy(chain)):
        assert isinstance(twin.radii, torch.nn.Parameter)
        assert twin.radii.requires_grad
        assert twin.offsets.requires_grad
        assert not isinstance(twin.offsets, torch.nn.Parameter)
        assert_close(twin(LENGTHS), chain(LENGTHS), rtol=0, atol=0)
    frozen = chain.frozen()
    assert not frozen(LENGTHS).requires_grad
    assert chain(LENGTHS).requires_grad
    single = copy.deepcopy(chain).float()
    assert_close(single(LENGTHS.float()).double(), chain(LENGTHS), rtol=0, atol=1e-6)
    q = torch.from_numpy(np.random.default_rng(2).uniform(0.1, 0.12, (80, 6)))
    x = chain(q).detach().numpy()
    model = HybridForwardModel(chain, "linear", calibrate=("radii",)).fit(q.numpy(), x)
    np.testing.assert_allclose(model.predict(q.numpy()), x, rtol=0, atol=1e-6)
    assert chain.radii.requires_grad


def test_states_of_earlier_versions_are_read():
    """They hold what is computed now."""
    arm = CHAINS["arm"][0]
    earlier = {**arm.state_dict(), "motions": torch.zeros(3, 3, 4, 4), "end": torch.eye(4)}
    earlier |= {"slides": torch.ones(3), "origins_at_zero": torch.zeros(3, 4, 4)}
    twin, q = copy.deepcopy(arm), torch.from_numpy(CHAINS["arm"][1])
    twin.load_state_dict(earlier)
    assert_close(twin(q), arm(q), rtol=0, atol=0)
    chain = copy.deepcopy(TRUNK)
    chain.load_state_dict(
        {**ConstantCurvatureChain(OTHER).state_dict(), "arc_matrix": torch.ones(1)}
    )
    assert_close(chain(LENGTHS), ConstantCurvatureChain(OTHER)(LENGTHS), rtol=0, atol=0)
    with pytest.raises(RuntimeError, match="Unexpected key"):
        chain.load_state_dict({**chain.state_dict(), "arc_matrices": torch.ones(1)})


def test_axes_of_any_length():
    arm, q = copy.deepcopy(CHAINS["arm"][0]), torch.from_numpy(CHAINS["arm"][1])
    before = arm.jacobian(q)
    arm.axes.mul_(torch.tensor([[2.0], [0.5], [3.0]]))
    assert_close(arm.jacobian(q), before, rtol=0, atol=1e-14)
    assert_close(torch.from_numpy(native.evaluate(arm, q.numpy(), jacobian=True)[1]), before)


def test_threads_see_one_state_or_the_other():
    """A result is never that of the state before its own."""
    chains = [TRUNK, TRUNK.with_geometry(radii=OTHER)]
    tips = [chain(LENGTHS) for chain in chains]
    shared, wrong, done = copy.deepcopy(TRUNK), [], threading.Event()

    def read():
        while not done.is_set():
            x = shared(LENGTHS)
            if not any(torch.equal(x, tip) for tip in tips):
                wrong.append(x)

    threads = [threading.Thread(target=read) for _ in range(2)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads meet at every place
    try:
        for thread in threads:
            thread.start()
        for k in range(100):
            shared.radii = chains[k % 2].radii
            if not torch.equal(shared(LENGTHS), tips[k % 2]):
                wrong.append(k)
    finally:
        done.set()
        for thread in threads:
            thread.join()
        sys.setswitchinterval(interval)
    assert not wrong


def test_an_entry_assigned_while_a_result_is_computed():
    class Doubled(torch.nn.Module):
        @derived("a")
        def result(self):
            first = self.a
            shared.a = torch.tensor(2.0)  # as by another thread
            return (first + self.a,)

    shared = Doubled()
    shared.register_buffer("a", torch.tensor(1.0))
    assert shared.result()[0] == 2.0
    assert shared.result()[0] == 4.0


def test_what_is_computed_in_a_transform_is_not_kept():
    chain = copy.deepcopy(TRUNK)
    for transform in (jacrev, jacfwd):
        assert_close(vmap(transform(chain))(LENGTHS), TRUNK.jacobian(LENGTHS), rtol=0, atol=1e-12)
        with torch.inference_mode():
            chain(LENGTHS)
        leaf = LENGTHS.clone().requires_grad_()
        assert torch.autograd.grad(chain(leaf).sum(), leaf)[0].abs().max() > 0.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_compiled_graphs_follow_the_state():
    for model, q in (CHAINS["trunk"], CHAINS["arm"]):
        chain, rows = copy.deepcopy(model), torch.from_numpy(q)
        graph = torch.compile(chain, backend="eager", fullgraph=True)
        assert_close(graph(rows), model(rows), rtol=0, atol=1e-12)
        for name, entry in chain.state_dict().items():
            entry.copy_(changed(name, entry, np.random.default_rng(0)))
            assert_close(graph(rows), chain(rows), rtol=0, atol=1e-12)


@pytest.mark.parametrize("operator", operators(2, 0.1).values())
def test_operators_do_not_change(operator):
    """What is derived from them, such as the width, stays right."""
    for twin in (operator, copy.deepcopy(operator), pickle.loads(pickle.dumps(operator))):
        for name, value in vars(twin).items():
            with pytest.raises(AttributeError, match="make a new one"):
                setattr(twin, name, value)
            if isinstance(value, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    value[...] = 0.0
        np.testing.assert_array_equal(twin.width, operator.width)
