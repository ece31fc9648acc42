"""Models and controllers in other systems: functional mock-up units, Octave, microcontrollers."""

import shutil

import numpy as np
import pytest
import rounding
import systems
import torch

from hybridkin import native

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
]
NEEDS_OCTAVE = pytest.mark.skipif(
    shutil.which("mkoctfile") is None, reason="needs Octave: apt install octave octave-dev"
)


@pytest.fixture(autouse=True)
def _without_fmpy(request):
    if "unit" in request.node.name:
        pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")


@pytest.mark.parametrize("kind", systems.MODELS)
def test_a_unit_of_a_model_computes_as_python(kind, tmp_path):
    model = systems.MODELS[kind]()
    unit = systems.Unit(native.export_fmu(model, tmp_path / "a.fmu"), tmp_path / "unpacked")
    q = systems.rows_near(9, 10)
    module = model if kind == "chain" else model.module_
    rows = torch.from_numpy(q)
    with torch.no_grad():
        x, J = module.forward_and_jacobian(rows)
        distances = module.domain_distance(rows)
    unit.start()
    for row, tip, slopes, distance in zip(q, x, J, distances, strict=True):
        unit.set(q=row)
        unit.step(0.1)
        np.testing.assert_allclose(unit.get("x"), tip, rtol=0, atol=1e-12)
        np.testing.assert_allclose(unit.get("jacobian"), slopes.ravel(), rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(unit.get("domain_distance")[0], distance, rtol=1e-9)


@pytest.mark.parametrize("kind", systems.CONTROLLERS)
def test_a_unit_of_a_controller_steps_as_python(kind, tmp_path):
    controller = systems.CONTROLLERS[kind]()
    q, targets, commands = systems.run_of_targets(controller)
    steps, *_ = systems.in_unit(controller, q, targets, tmp_path)
    close = rounding.of_commands([q, *commands])
    np.testing.assert_allclose(steps, commands, rtol=0, atol=close)


def test_a_unit_closes_the_loop_with_measurements_and_restores_its_state(tmp_path):
    controller = systems.CONTROLLERS["trunk"]()
    unit = systems.Unit(native.export_fmu(controller, tmp_path / "a.fmu"), tmp_path / "unpacked")
    tracker = controller.tracker(np.full(9, 0.22))
    unit.start(start=np.full(9, 0.22))
    target = np.array([0.05, 0.02, 0.68])
    commands = [tracker.q]
    for k in range(40):
        measured = tracker.x + 0.003 if k % 2 else None
        unit.set(target=target, measured=np.full(3, np.nan) if measured is None else measured)
        unit.step(0.02)
        commands.append(tracker.step(target, x_measured=measured))
        close = rounding.of_commands(commands)
        np.testing.assert_allclose(unit.get("command"), commands[-1], rtol=0, atol=close)
    state = unit.unit.getFMUState()
    unit.step(0.02)
    first = unit.get("command")
    unit.unit.setFMUState(state)
    unit.step(0.02)
    np.testing.assert_array_equal(unit.get("command"), first)
    unit.set(target=[np.nan] * 3)
    unit.step(0.02)
    assert unit.get("status")[0] == 2.0


@NEEDS_OCTAVE
@pytest.mark.parametrize(
    "kind", ["trunk", "network", "elastic", "half-space", "hysteresis", "obstacles"]
)
def test_octave_computes_as_python(kind, tmp_path):
    controller = systems.CONTROLLERS[kind]()
    module = controller.settings.task.steered[0]
    n = module.n_actuators
    q = systems.rows_near(n, 10)
    q[-1] *= 3.0  # far away
    with torch.no_grad():
        x, J = module.forward_and_jacobian(torch.from_numpy(q))
    rng = np.random.default_rng(0)
    targets = x[0].numpy() + np.cumsum(1e-3 * rng.standard_normal((30, 3)), axis=0)
    targets[-3:] += 10.0  # out of reach
    models, steps, messages = systems.in_octave(controller, q, targets, tmp_path)
    assert len(messages) == 5
    assert "NO ERROR" not in messages
    assert "reset" in messages[1]
    np.testing.assert_allclose(models[:, :3], x, rtol=1e-12, atol=1e-12)
    slopes = J.reshape(len(q), -1)
    np.testing.assert_allclose(models[:, 3 : 3 + 3 * n], slopes, rtol=1e-10, atol=1e-10)
    tracker = controller.tracker(q[0])
    commands = [tracker.step(target) for target in targets]
    close = rounding.of_commands([q[0], *commands])
    np.testing.assert_allclose(steps[:, :n], commands, rtol=0, atol=close)
