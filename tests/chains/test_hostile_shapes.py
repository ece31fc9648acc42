"""Heavy bodies and hard pulls: shapes are at rest and stable, or there is none and a reason."""

import shutil
import subprocess
import sys
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ElasticTendonChain,
    ForceTendonChain,
    HybridForwardModel,
    IKStatus,
    InverseKinematics,
    calibrate,
)
from hybridkin.native import available, export_c
from hybridkin.native.library import evaluate

sys.path.append(str(Path(__file__).parents[1] / "examination"))
import shapes

LENGTH, STIFFNESS = 0.3, 0.02


def column(ratio, **changes):
    """Return an upright uniform column with this weight L^3 / E I."""
    options = {"weight": ratio * STIFFNESS / LENGTH**3, "axial_stiffness": 2000.0, **changes}
    axial = options.pop("axial_stiffness")
    return ForceTendonChain([0.01], [LENGTH], STIFFNESS, axial, **options)


def rows(*forces):
    return torch.tensor(forces, dtype=torch.float64)


def silently(function, *arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(*arguments)


@pytest.mark.slow
def test_random_shapes_are_at_rest_and_stable():
    lines = list(shapes.examine(full=False))
    failed = [line for line in lines if not line.holds]
    assert len(lines) == 16
    assert not failed


def test_a_search_that_did_not_end_has_no_number():
    body = ForceTendonChain([0.01], [0.3], 0.0012, 33.0, weight=2.5)
    q = rows([0.8, 0.8, 0.8], [0.8, 0.8, 0.3])
    with pytest.warns(UserWarning, match=r"buckled: in row 0 .*\[0.8, 0.8, 0.8\]"):
        x = body(q)
    assert x.isfinite().all(1).tolist() == [False, True]
    assert_close(x[1], body(q[1]))  # a row without a shape touches no other


def test_columns_fall_at_the_load_of_greenhill():
    # A uniform column stands by itself while w L^3 / E I < 7.8373 (Greenhill 1881).
    stiff = {"axial_stiffness": 1e7, "arcs": 40}
    assert column(7.82, **stiff)(rows(0.0, 0.0, 0.0)).isfinite().all()
    with pytest.warns(UserWarning, match=r"buckled.*stands on its base.*= 7.86"):
        assert column(7.86, **stiff)(rows(0.0, 0.0, 0.0)).isnan().all()


@pytest.mark.parametrize("ratio", [0.1, 1.0, 7.0, 9.0, 10.8, 30.0, 100.0])
def test_upright_and_hanging_columns(ratio):
    """Straight without a pull, or buckled; with a pull, a shape to its side whose J is right."""
    straight, pulled = rows(0.0, 0.0, 0.0), rows(0.5, 0.1, 0.0)
    for gravity in ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]):
        body = column(ratio, gravity=gravity)
        stands = ratio < 7.8 or gravity[2] > 0.0
        x = silently(body, straight)
        assert bool(x.isfinite().all()) == stands == bool(body.in_domain(straight))
        if stands:
            assert_close(x[:2], torch.zeros(2, dtype=torch.float64), rtol=0.0, atol=1e-12)
        x, J = body.forward_and_jacobian(pulled)
        assert x[0] > 0.0
        step = 1e-5 * torch.eye(3, dtype=torch.float64)
        difference = (body(pulled + step) - body(pulled - step)).mT / 2e-5
        assert_close(J[:, :2], difference[:, :2], rtol=1e-5, atol=1e-7)


def test_a_body_falls_to_the_side_of_a_small_pull_in_every_direction():
    body = column(10.8, n_actuators=1)
    for angle in torch.linspace(0.0, 6.0, 7, dtype=torch.float64):
        turned = body.with_geometry(angles=angle[None])
        x, y, _ = turned(rows(1e-3))
        fallen = torch.atan2(y, x).remainder(2.0 * torch.pi)
        assert_close(fallen, angle, rtol=0.0, atol=1e-6)
        assert torch.hypot(x, y) > 0.2


def test_the_side_is_not_that_of_rounding():
    for dtype in (torch.float64, torch.float32):
        base = torch.linalg.qr(
            torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double()
        )
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = base.Q * base.Q.det()
        down = -pose[:3, 2]
        body = column(20.0, base=pose, gravity=down, dtype=dtype, angles=[0.3, 2.5, 4.7])
        with pytest.warns(UserWarning, match="buckled"):
            assert body(rows(0.0, 0.0, 0.0).to(dtype)).isnan().all()


def test_no_arc_is_shorter_than_a_tenth():
    body = ForceTendonChain([0.01], [0.1], 0.02, 20.0)
    pull = torch.linspace(0.05, 10.05, 41, dtype=torch.float64)[:, None].expand(-1, 3)
    is_short = 3.0 * pull[:, 0] > 0.9 * 20.0
    with pytest.warns(UserWarning, match="compressed: in rows 24, 25, 26, 27, 28 and 12 more"):
        lengths, _ = body.arcs(pull)
    assert (lengths.isnan().any(1) == is_short).all()
    assert (lengths[~is_short] >= 0.1 * 0.1 / 6.0).all()
    assert (body.in_domain(pull) == ~is_short).all()


def test_rows_are_named_beyond_the_first_block():
    body = ForceTendonChain([0.01], [0.1], 0.02, 20.0, arcs=1)
    q = torch.full((9000, 3), 0.5, dtype=torch.float64)
    q[8500] = 10.0
    with pytest.warns(UserWarning, match="in row 8500 "):
        x = body(q)
    assert x.isnan().any(1).nonzero().tolist() == [[8500]]


@pytest.mark.parametrize(
    "bad", [[10.0, 10.0, 10.0], [torch.nan, 1.0, 1.0], [torch.inf, 0, 0], [1e200, 0, 0]]
)
def test_a_row_without_a_shape_touches_no_gradient_of_others(bad):
    body = ForceTendonChain([0.01], [0.1], 0.02, 20.0, weight=1.0, arcs=2)
    q = rows([0.5, 0.1, 0.0], bad).requires_grad_()
    stiffness = body.bending_stiffness.clone().requires_grad_()
    x = silently(body.with_geometry(bending_stiffness=stiffness), q)
    assert x.isfinite().all(1).tolist() == [True, False]
    slopes = torch.autograd.grad(x[0].sum(), [q, stiffness])
    alone = torch.autograd.grad(
        body.with_geometry(bending_stiffness=stiffness)(q[:1]).sum(), [q, stiffness]
    )
    assert_close(slopes[0][0], alone[0][0])
    assert_close(slopes[1], alone[1])
    _, J = silently(body.forward_and_jacobian, q.detach())
    assert J.isfinite().flatten(1).all(1).tolist() == [True, False]


def test_tiny_robots_are_at_rest_too():
    # The same body in units of a tenth of a millimetre and micronewtons.
    body = column(5.0, gravity=[1.0, 0.2, -0.5])
    q = rows([0.5, 0.1, 0.0], [2.0, 0.0, 0.3])
    small = ForceTendonChain(
        [1e-6],
        [LENGTH * 1e-4],
        STIFFNESS * 1e-14,
        2000.0 * 1e-6,
        weight=5.0 * STIFFNESS / LENGTH**3 * 1e-2,
        gravity=[1.0, 0.2, -0.5],
    )
    assert_close(1e4 * small(1e-6 * q), body(q), rtol=0.0, atol=1e-9)


def test_logs_name_rows_without_a_shape():
    body = column(10.8)
    q = np.random.default_rng(0).uniform(0.1, 3.0, (12, 3))
    x = body(torch.from_numpy(q)).numpy()
    q[5] = 0.0
    need = r"`{}` must hold forces at which the body has a shape, got buckled: in row 5 "
    with pytest.raises(ValueError, match=need.format("q")):
        calibrate(body, q, x, ("bending_stiffness",))
    with pytest.raises(ValueError, match=need.format("X")):
        HybridForwardModel(body, "quadratic").fit(q, x)


@pytest.mark.slow
def test_inverse_kinematics_leaves_a_start_without_a_tip():
    body = column(10.8)
    q = np.random.default_rng(0).uniform(0.0, 3.0, (3, 3))
    ik = InverseKinematics(body, q_min=0.0, q_max=3.0)
    solution = ik.solve(body(torch.from_numpy(q)).numpy())  # from equal forces: buckled
    assert (solution.status == IKStatus.CONVERGED).all()


def _elastic():
    return ElasticTendonChain([0.01], [0.1], axial_stiffness=0.5)


def test_elastic_tendons_do_not_turn_a_body_inside_out():
    body = _elastic()
    q = torch.linspace(0.0, -0.2, 21, dtype=torch.float64)[:, None].expand(-1, 3)
    # Three taut tendons share the work: the length changes by 3 q / (3 + k).
    is_short = 0.1 + 3.0 * q[:, 0] / 3.5 < 0.01
    with pytest.warns(UserWarning, match="compressed: in rows 11, 12, 13, 14, 15 and 5 more"):
        x = body(q)
    assert (x.isnan().any(1) == is_short).all()
    assert (body.in_domain(q) == ~is_short).all()
    assert body.contradictions(q[:11]) == []
    assert "rows 11, 12" in body.contradictions(q)[0]
    if available():
        by_core, J = evaluate(body, q.numpy(), jacobian=True)
        assert_close(torch.from_numpy(by_core), x, equal_nan=True)
        assert (np.isnan(J).any((1, 2)) == is_short.numpy()).all()


def test_hybrids_name_compressed_rows():
    body = _elastic()
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.03, 0.03, (40, 3))
    x = body(torch.from_numpy(q)).numpy() + 1e-4 * rng.normal(size=(40, 3))
    model = HybridForwardModel(body, "drop").fit(q, x)
    far = np.vstack([q[:2], [[-0.15, -0.15, -0.15]]])
    with pytest.warns(UserWarning, match="compressed: in row 2 "):
        predicted = model.predict(far)
    assert np.isfinite(predicted).all(axis=1).tolist() == [True, True, False]
    assert model.in_domain(far).tolist() == [True, True, False]
    adapted = silently(model.adapt, q[:8], x[:8] + 0.001)
    for module in (model.module_, adapted.module_):
        assert module.in_domain(torch.from_numpy(far)).tolist() == [True, True, False]


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.slow
def test_exported_c_agrees_on_compressed_rows(tmp_path):
    ik = InverseKinematics(_elastic(), q_min=-0.2, q_max=0.05, dt=0.02, dq_max=0.5)
    export_c(ik, tmp_path, name="robot")
    sources = [tmp_path / "robot.c", tmp_path / "robot_test.c"]
    program = tmp_path / "check"
    subprocess.run(["cc", "-std=c99", "-O0", "-o", program, *sources, "-lm"], check=True)
    checked = subprocess.run([program], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout


def test_random_elastic_bodies_have_no_short_arc_and_plausible_rows_none():
    rng = np.random.default_rng(1)
    counts = Counter()
    for _ in range(60):
        S, k = rng.integers(1, 4), rng.integers(1, 5)
        lengths = rng.uniform(0.05, 0.2, S)
        body = ElasticTendonChain(
            rng.uniform(0.003, 0.02, S),
            lengths,
            n_actuators=int(k),
            axial_stiffness=10.0 ** rng.uniform(-1.5, 1.0, S),
            routing=str(rng.choice(["base", "segment"])),
            tendon_zeros=rng.choice([0.0, 0.003]) * rng.normal(size=S * k),
            rest_bends=rng.choice([0.0, 0.3]) * rng.normal(size=(S, 2)),
            gains=rng.choice([1.0, -1.0]),
        )
        q = rng.normal(size=(20, S * k)) * 10.0 ** rng.uniform(-3.0, -0.5, (20, 1))
        found, _ = silently(body.arcs, torch.from_numpy(q))
        has_shape = found.isfinite().all(1).numpy()
        assert (found[has_shape] >= 0.1 * torch.from_numpy(lengths)).all()
        bounds = body.plausible_rows()
        plausible = np.array([bounds.hold(row[None]) for row in q])
        assert has_shape[plausible].all()
        counts.update(zip(plausible.tolist(), has_shape.tolist(), strict=True))
    assert min(counts[True, True], counts[False, True], counts[False, False]) > 50, counts
