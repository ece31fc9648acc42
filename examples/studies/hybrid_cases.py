"""Robots, training rows, test rows and models of the study `hybrids`."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from simulated_trunk import PAPER_ELM, make_trunk
from sklearn.compose import TransformedTargetRegressor
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GridSearchCV, GroupKFold, KFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures, StandardScaler
from threadpoolctl import threadpool_limits

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    datasets,
    robots,
)

PLANTS: dict[str, dict[str, Any]] = {
    "trunk 1": {},
    "trunk 2": {"tilt": 1.2, "mass": 1.6, "tip_mass": 0.15, "bending_stiffness": 1.3},
}
"""Arguments of `TrunkPlant` by name; the seed of a plant is its position."""

NOMINAL, CALIBRATED = "mechanical, nominal", "mechanical, calibrated"
PAPER, AUTO, AUTO_PLAY = "parallel, the paper's ELM", "auto", 'auto, hysteresis="auto"'
DATA_ONLY = ("data alone, quadratic", "data alone, kernel ridge")
AUTO_MECHANICS = "mechanical, as auto took it"
STRUCTURAL = "serial, structural"
COUPLINGS, READOUTS = ("parallel", "serial"), ("quadratic", "pose")
INNER = (0.6, 0.8)
"""Parts of the range of every actuator of the trunks that are learned from; the rest is tested."""

KERNEL_ROWS = 2000
"""Largest number of rows with kernel ridge, as in auto: 180 fits choose its width and penalty."""

_CABLE_NOISE, _MOCAP_NOISE = 1e-3, 5e-4  # as the defaults of `make_trunk` [m]
_LOW, _HIGH = 0.19, 0.31  # the range of `paper_protocol` [m]
_NEAR = 6.05e-3  # cables of the inner part of armlab_3cable [m]
_PULLED = 0.6  # of the largest pull of every tendon of ftdcr_v4: its inner part
_PAIRS = ((2, 3), (1, 4), (0, 5))  # motors of asl_trunk_static by segment, base to tip
SPOOL = 0.05  # tendon per unit of their commands, a guess [m]


class Case(NamedTuple):
    """Training rows and test rows, with the robot's nominal kinematics."""

    name: str
    draw: int
    chain: Any
    # Calibrated even in the nominal model: where the frame is unknown.
    frame: tuple[str, ...]
    calibrate: tuple[str, ...] | str  # of all models but auto, which chooses for itself
    q: NDArray
    x: NDArray
    groups: NDArray | None
    tests: dict[str, tuple[NDArray, ...]]  # q, x and, where there are motions, these
    in_time: bool = False  # whether the rows of a group are in the order of time


@threadpool_limits.wrap(limits=1)  # CPU time of one thread
def examined(case: Case, names: Sequence[str] | None) -> list[dict[str, Any]]:
    """Return the entries of a case, of the models with these names or all."""
    entries = []
    with warnings.catch_warnings():  # a plain chain warns of slack tendons, as in ftdcr_v4
        warnings.simplefilter("ignore", UserWarning)
        for name, learner in _learners(case).items():
            if names is not None and name not in names:
                continue
            start = time.process_time()
            model = learner().fit(case.q, case.x, groups=case.groups)
            entry = {
                "case": case.name,
                "draw": case.draw,
                "n": len(case.q),
                "model": name,
            }
            entry["seconds"] = time.process_time() - start
            if model.cv_results_ is not None:
                results = model.cv_results_
                scores = zip(results["candidate"], results["mean_distance"].tolist(), strict=True)
                entry |= {"chosen": results["chosen"], "scores": dict(scores)}
                entry |= {key: results[key] for key in ("expected_distance", "weights")}
                entry["parameters"] = results["parameters"]
                entry["mechanics"] = results["mechanical_model"]
            errors = {test: _errors(model, *rows) for test, rows in case.tests.items()}
            entries.append({**entry, "errors": errors})
            if name == AUTO:
                alone = HybridForwardModel(model.mechanical_model_, "drop").fit(case.q, case.x)
                errors = {test: _errors(alone, *rows) for test, rows in case.tests.items()}
                parts = {key: entry[key] for key in ("case", "draw", "n")}
                entries.append({**parts, "model": AUTO_MECHANICS, "errors": errors})
    return entries


def _errors(
    model: HybridForwardModel, q: NDArray, x: NDArray, groups: NDArray | None = None
) -> dict[str, float]:
    errors = np.linalg.norm(model.predict(Commands(q, groups)) - x, axis=1)
    return {
        "mean": float(errors.mean()),
        "max": float(errors.max()),
        "n_test": len(errors),
    }


def _learners(case: Case) -> dict[str, Callable[[], HybridForwardModel]]:
    """Return the models by name; all but auto share one calibration to all rows."""
    q, x, groups, seed = case.q, case.x, case.groups, case.draw
    splitter: Any = KFold(5, shuffle=True, random_state=seed)
    if groups is not None:
        splitter = GroupKFold(min(5, len(np.unique(groups))))
    folds = [*splitter.split(q, groups=groups)]
    calibrated = HybridForwardModel(case.chain, "drop", calibrate=case.calibrate).fit(q, x)
    hybrid = partial(HybridForwardModel, calibrated.mechanical_model_, random_state=seed)
    learners: dict[str, Callable[[], HybridForwardModel]] = {
        NOMINAL: lambda: HybridForwardModel(case.chain, "drop", calibrate=case.frame),
        CALIBRATED: lambda: hybrid("drop"),
        DATA_ONLY[0]: lambda: HybridForwardModel(None, _quadratic()),
        PAPER: lambda: hybrid(ELMRegressor(**PAPER_ELM, random_state=seed)),
    }
    if len(q) <= KERNEL_ROWS:
        learners[DATA_ONLY[1]] = lambda: HybridForwardModel(None, _kernel(q, x, folds))
        learners["parallel, kernel ridge"] = lambda: hybrid(
            _kernel(q, x - calibrated.predict(q), folds)
        )
    for coupling in COUPLINGS:
        for kind in READOUTS:
            learners[f"{coupling}, {kind}"] = partial(hybrid, kind, coupling=coupling)
    learners["serial, pose, no guard"] = partial(hybrid, "pose", coupling="serial", guard=None)
    learners[STRUCTURAL] = partial(hybrid, "structural", coupling="serial")
    auto = partial(HybridForwardModel, case.chain, AUTO, random_state=seed)
    learners[AUTO] = auto
    if case.in_time:
        learners[AUTO_PLAY] = partial(auto, hysteresis="auto")
    return learners


def _quadratic() -> Any:
    features = PolynomialFeatures(2, include_bias=False)
    return make_pipeline(MinMaxScaler((-1, 1)), features, RidgeCV(np.logspace(-6, 3, 19)))


def _kernel(q: NDArray, y: NDArray, folds: list[tuple[NDArray, NDArray]]) -> Any:
    """Return kernel ridge with the width and the penalty of least error on the folds."""
    ridge = make_pipeline(StandardScaler(), KernelRidge(kernel="rbf"))
    grid = {"alpha": np.logspace(-5, 0, 6), "gamma": (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)}
    grid = {f"kernelridge__{name}": values for name, values in grid.items()}
    search = GridSearchCV(ridge, grid, cv=folds, scoring="neg_mean_squared_error", refit=False)
    ridge.set_params(**search.fit(q, y - y.mean(0)).best_params_)
    return TransformedTargetRegressor(ridge, transformer=StandardScaler(with_std=False))


def trunk_cases(
    sizes: Sequence[int],
    n_draws: int,
    n_test: int,
    folder: Any,
    n_jobs: int | None,
    inner: float | None = None,
) -> list[Case]:
    """Return the cases of the simulated trunks; `inner` trains within that part of the range."""
    cases, largest = [], max(sizes)
    for seed, name in enumerate(PLANTS):
        make = partial(without_noise, name, folder, n_jobs)
        rows = make(n_random=n_test + (n_draws * largest if inner is None else 0))
        test, data = (
            (rows[0][:n_test], rows[1][:n_test]),
            (rows[0][n_test:], rows[1][n_test:]),
        )
        if inner is not None:
            middle, half = 0.5 * (_LOW + _HIGH), 0.5 * inner * (_HIGH - _LOW)
            unit = np.random.default_rng([seed, round(100 * inner)])
            unit = unit.random((n_draws * largest, 9))
            data = make(q_target=middle + half * (2.0 * unit - 1.0))
            beyond = (np.abs(test[0] - middle) > half).any(1)
            test = test[0][beyond], test[1][beyond]
            name = f"{name}, inner {100 * inner:.0f} %"
        tests = {"without noise": test, "with noise": _noisy(*test, [seed, 1])}
        for draw in range(n_draws):
            drawn = slice(draw * largest, (draw + 1) * largest)
            q, x = _noisy(data[0][drawn], data[1][drawn], [seed, 2, draw])
            chain = robots.bionic_handling_assistant()
            cases += [
                Case(name, draw, chain, (), "default", q[:n], x[:n], None, tests) for n in sizes
            ]
    return cases


def without_noise(
    name: str, folder: Any, n_jobs: int | None, **rows: Any
) -> tuple[NDArray, NDArray]:
    """Return rows of a plant without noise, so that it can be added or not."""
    return make_trunk(
        **rows,
        n_segment=0,
        random_state=[*PLANTS].index(name),
        cable_noise=0.0,
        mocap_noise=0.0,
        n_jobs=n_jobs,
        checkpoint=folder,
        return_X_y=True,
        **PLANTS[name],
    )


def _noisy(q: NDArray, x: NDArray, seed: list[int]) -> tuple[NDArray, NDArray]:
    rng = np.random.default_rng(seed)
    noise = (
        _CABLE_NOISE * rng.standard_normal(q.shape),
        _MOCAP_NOISE * rng.standard_normal(x.shape),
    )
    return q + noise[0], x + noise[1]


def recording(load: Callable[[Any], Any], data_home: Any) -> Any:
    """Return a recording, or None with a warning where it is absent."""
    try:
        return load(data_home)
    except FileNotFoundError as missing:
        warnings.warn(f"Left out: {missing}", stacklevel=4)
        return None


class Robot(NamedTuple):
    """The rows of a recorded robot, with its nominal kinematics; see `Case`."""

    name: str
    chain: Any
    frame: tuple[str, ...]
    calibrate: tuple[str, ...] | str
    q: NDArray
    x: NDArray
    groups: NDArray

    def drawn(self, draw: int, rows: NDArray, test: NDArray, sizes: Sequence[int]) -> list[Case]:
        """Return a case for every size: the first ones of these rows, tested on others."""
        tests = {"measured": (self.q[test], self.x[test])}
        cases = []
        for n in sizes:
            some = rows[:n]
            data = self.q[some], self.x[some], self.groups[some]
            mechanics = self.chain, self.frame, self.calibrate
            cases.append(Case(self.name, draw, *mechanics, *data, tests))
        return cases


def recorded_cases(robot: Robot, sizes: Sequence[int], n_draws: int, n_test: int) -> list[Case]:
    """Return the cases of a recorded robot: single rows, a fifth of its groups held out.

    The rows and the groups are drawn at random. Sizes with more rows than there are are left out.
    """
    cases, motions = [], np.unique(robot.groups)
    for draw in range(n_draws):
        rng = np.random.default_rng(draw)
        held_out = rng.permutation(motions)[: len(motions) // 5]
        out = np.isin(robot.groups, held_out)
        rows, test = (rng.permutation(np.flatnonzero(part)) for part in (~out, out))
        within = [n for n in sizes if n <= len(rows)]
        cases += robot.drawn(draw, rows, test[:n_test], within)
    return cases


def armlab(data_home: Any) -> Robot | None:
    """Return armlab_3cable, groups are lines of its grid; None where it is absent."""
    data = recording(datasets.load_armlab, data_home)
    if data is None:
        return None
    turns = -2.0 * np.pi / 3.0 * np.arange(3)[None]
    chain = ConstantCurvatureChain([0.003], angles=turns, lengths=[0.15])
    parameters = ("radii", "lengths", "base", "tool")
    rows = data.q, data.x, data.groups
    return Robot("armlab_3cable", chain, ("base",), parameters, *rows)


def pull_cases_of_armlab(n: int, n_draws: int, n_test: int, data_home: Any) -> list[Case]:
    """Return the cases of armlab_3cable that are learned from small pulls."""
    robot = armlab(data_home)
    if robot is None:
        return []
    robot = robot._replace(name="armlab_3cable, pulls up to 6 mm")
    near = (robot.q >= -_NEAR).all(1)
    cases = []
    for draw in range(n_draws):
        rng = np.random.default_rng(draw)
        rng.permutation(np.unique(robot.groups))  # as in `recorded_cases`: same stream
        rows, test = (rng.permutation(np.flatnonzero(part)) for part in (near, ~near))
        cases += robot.drawn(draw, rows, test[:n_test], [n])
    return cases


def plain_ftdcr(data_home: Any) -> Robot | None:
    """Return ftdcr_v4 with its plain chain, groups are motions; None where it is absent."""
    data = recording(datasets.load_ftdcr, data_home)
    if data is None:
        return None
    chain, parameters = nine_tendons()["plain chain"]
    return Robot("ftdcr_v4", chain, ("base",), parameters, data.q, data.x, data.groups)


def asl_trunk(data_home: Any) -> Robot | None:
    """Return asl_trunk_static, groups are runs; None where it is absent.

    Each motor pulls one tendon of its segment and releases the opposite one.
    """
    data = recording(datasets.load_asl_trunk, data_home)
    if data is None:
        return None
    q = np.hstack([SPOOL * sign * data.q[:, pair] for pair in _PAIRS for sign in (-1.0, 1.0)])
    chain = ConstantCurvatureChain(np.full(3, 0.02), n_actuators=4, lengths=(0.107, 0.098, 0.12))
    return Robot("asl_trunk_static", chain, ("base",), "default", q, data.x, data.groups)


def nine_tendons() -> dict[str, tuple[Any, tuple[str, ...]]]:
    """Return the mechanical models of ftdcr_v4 by name, and what to calibrate of each."""
    radii, turns = np.full(3, 0.0045), 2.0 * np.pi / 3.0 * np.arange(3)
    geometry: dict[str, Any] = {
        "lengths": (0.06, 0.0625, 0.064),
        "angles": np.add.outer([-3.03, -2.52, -2.01], turns),
        "routing": "base",
    }
    plain = ConstantCurvatureChain(radii, **geometry)
    elastic = ElasticTendonChain(
        radii, **geometry, bending_stiffness=0.15 * radii**2, axial_stiffness=10.0
    )
    stiff = ("rest_bends", "bending_stiffness", "axial_stiffness", "tendon_zeros")
    return {
        "plain chain": (plain, ("base", "tool", "radii", "lengths")),
        "elastic tendons": (elastic, ("base", "tool", *stiff)),
    }


def pull_cases(data_home: Any, thin: int) -> list[Case]:
    """Return the cases of ftdcr_v4 that are learned from small pulls; none without the data."""
    data = recording(datasets.load_ftdcr, data_home)
    if data is None:
        return []
    near = (data.q >= _PULLED * data.q.min(0)).all(1)
    rows = np.flatnonzero(near)[::thin]
    tests = {"measured": (data.q[~near], data.x[~near])}
    part = data.q[rows], data.x[rows], data.groups[rows]
    return [
        Case(f"ftdcr_v4, {name}", 0, chain, ("base",), parameters, *part, tests)
        for name, (chain, parameters) in nine_tendons().items()
    ]


def run_cases(data_home: Any, thin: int) -> list[Case]:
    """Return the cases of asl_trunk_static, whole runs in five folds; none without the data."""
    robot = asl_trunk(data_home)
    if robot is None:
        return []
    cases = []
    splits = GroupKFold(5).split(robot.q, groups=robot.groups)
    for k, (train, test) in enumerate(splits):
        rows = train[::thin]
        part = robot.q[rows], robot.x[rows], robot.groups[rows]
        tests = {"5 folds": (robot.q[test], robot.x[test], robot.groups[test])}
        mechanics = robot.chain, robot.frame, robot.calibrate
        cases.append(Case(robot.name, k, *mechanics, *part, tests))
    return cases


def motion_cases(data_home: Any, thin: int) -> list[Case]:
    """Return the cases of ftdcr_v4, none where the recording is absent."""
    data = recording(datasets.load_ftdcr, data_home)
    if data is None:
        return []
    families = np.array([label.split("_")[1] for label in data.groups])
    single, pair = (np.flatnonzero(np.char.startswith(families, w)) for w in ("seg", "pair"))
    folds = list(GroupKFold(5).split(data.q, groups=data.groups))
    pairs = [
        (np.flatnonzero(families != name), np.flatnonzero(families == name))
        for name in np.unique(families[pair])
    ]
    ways = {
        "5 folds": (folds, data.groups),
        "a pair held out": (pairs, data.groups),
        "pairs from single segments": ([(single, pair)], data.groups),
        "the same, groups: segments": ([(single, pair)], families),
    }
    cases = []
    for name, (chain, parameters) in nine_tendons().items():
        for way, (splits, groups) in ways.items():
            for k, (train, test) in enumerate(splits):
                rows = train[::thin]
                part = data.q[rows], data.x[rows], groups[rows]
                tests = {way: (data.q[test], data.x[test], data.groups[test])}
                in_time = groups is data.groups
                cases.append(Case(name, k, chain, ("base",), parameters, *part, tests, in_time))
    return cases
