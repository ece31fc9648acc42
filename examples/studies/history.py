"""Averages of past commands as linear inputs, beside `hysteresis="auto"`: what they bring.

The table of the docs page "Results", section "Hysteresis and creep"::

    python examples/studies/history.py

About four minutes of processor time. The model is x = f(z(y) + W [1, y] + sum_k W_k (a_k - q)):
f is the calibrated chain, z are its arcs, a_k are averages of the commands q until now, with four
time constants from a step of the log to the length of a run, and y is what the actuators do. Ridge
finds all weights, with one penalty for W and one for the W_k; whole groups of the training rows
choose both among values up to infinity. The way by which the last sum moves the tip is subtracted
from the measured tips before the error model is fitted, and added to its predictions.

With ``--error-model auto`` the error model is "auto" instead of serial quadratic features; this
takes a quarter of an hour. The recordings are in the folder that ``--data`` or HYBRIDKIN_DATA
names; an absent one is left out. They have no times, but for asu_bellows: the number of a row in
its run stands for them.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from bellows import Recording, nominal
from hybrid_cases import asl_trunk, plain_ftdcr
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold

from hybridkin import (
    Commands,
    ForwardModel,
    HybridForwardModel,
    Hysteresis,
    as_forward_model,
    choose_geometry,
    robots,
)

TRUNK = robots.bionic_handling_assistant()
MOST = 300  # training rows that count
FOLDS = 5
PENALTIES = 10.0 ** np.arange(-5, 3)
ROUNDS = 3  # Gauss-Newton
Penalties = tuple[float, float]


class Log(NamedTuple):
    """Commands, tips and times of runs, groups to hold out, and which rows count."""

    name: str
    chain: Any
    q: NDArray
    x: NDArray
    runs: NDArray
    time: NDArray
    groups: NDArray
    counts: NDArray

    def commands(self, rows: NDArray) -> Commands:
        """Return the commands of all rows of some runs."""
        return Commands(self.q[rows], self.runs[rows], self.time[rows])

    def behind(self) -> NDArray:
        """Return a_k - q for four time constants (N, 4 n)."""
        steps = []
        lengths = []
        for run in np.unique(self.runs):
            of_run = self.time[self.runs == run]
            steps.append(np.diff(of_run))
            lengths.append(np.ptp(of_run))
        times = np.geomspace(np.median(np.concatenate(steps)), np.median(lengths), 4)
        return np.hstack([self.average(tau) - self.q for tau in times])

    def average(self, tau: float) -> NDArray:
        """Return the average of the commands until now with a time constant (N, n)."""
        half_late = Hysteresis.creep([0.5], [tau])
        late = half_late.apply_by_group(self.q, self.runs, self.time)
        return 2.0 * late - self.q


class History:
    """How the past moves the tips of a model: the weights of averages, by ridge.

    Parameters
    ----------
    model : ForwardModel
        The calibrated chain.
    y, past, x : ndarray of shape (N, n), (N, H), (N, m)
        What the actuators do, averages of the past, and tips [m].
    groups : ndarray of shape (N,)
        Groups that are held out to choose the penalties.
    """

    def __init__(
        self, model: ForwardModel, y: NDArray, past: NDArray, x: NDArray, groups: NDArray
    ) -> None:
        self.model = model
        self.center = y.mean(axis=0)
        self.scale = np.maximum(np.ptp(y, axis=0), 1e-9) / 2.0
        self.size = np.maximum(past.std(axis=0), 1e-9)
        self.n_linear = 1 + y.shape[1]
        inputs = self.inputs(y, past)
        z = self.arcs(y)
        splitter = GroupKFold(min(FOLDS, len(np.unique(groups))))
        folds = [*splitter.split(y, groups=groups)]
        # Units in which every arc moves the tip by 1 m (rms); arcs that cannot move have none.
        moved = np.sqrt(np.square(self.tips(z)[1]).sum(axis=1).mean(axis=0))
        self.units = np.zeros(len(moved))
        moves = moved > 1e-9 * moved.max()
        self.units[moves] = 1.0 / moved[moves]
        self.scaled = np.zeros((len(moved), inputs.shape[1]))
        for _ in range(ROUNDS):
            columns, target = self.linearised(z, inputs, x)
            candidates = [(alpha, np.inf) for alpha in PENALTIES]
            best = self.best(candidates, columns, target, folds)
            candidates = [(best[0], alpha) for alpha in (*PENALTIES, np.inf)]
            self.penalties = self.best(candidates, columns, target, folds)
            self.scaled = self.solution(columns, target, self.penalties)

    def inputs(self, y: NDArray, past: NDArray) -> NDArray:
        """Return the inputs: 1, y and the past, scaled, shape (N, 1 + n + H)."""
        return np.column_stack([np.ones(len(y)), (y - self.center) / self.scale, past / self.size])

    def arcs(self, y: NDArray) -> NDArray:
        """Return z(y), shape (N, Z)."""
        with torch.no_grad():
            return self.model.coordinates(torch.from_numpy(y))[0].numpy()

    def tips(self, z: NDArray) -> tuple[NDArray, NDArray]:
        """Return tips (N, m) and their derivative by z (N, m, Z)."""
        with torch.no_grad():
            x, J = self.model.from_coordinates_and_jacobian(torch.from_numpy(z))
        return x.numpy(), J.numpy()

    def linearised(self, z: NDArray, inputs: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        """Return columns (N, m, Z (1 + n + H)) and targets (N, m) of the next step."""
        change = inputs @ self.scaled.T
        tips, J = self.tips(z + self.units * change)
        J = J * self.units
        target = x - tips + (J @ change[..., None])[..., 0]
        return (J[..., None] * inputs[:, None, None]).reshape(*J.shape[:2], -1), target

    def solution(self, columns: NDArray, target: NDArray, penalties: Penalties) -> NDArray:
        """Return the weights (Z, 1 + n + H) of scaled arcs; an infinite penalty makes zeros."""
        n_arcs = len(self.units)
        n_inputs = columns.shape[2] // n_arcs
        sizes = [1, self.n_linear - 1, n_inputs - self.n_linear]
        alpha = np.tile(np.repeat([1e-6, *penalties], sizes), n_arcs)
        used = alpha < np.inf
        A = columns[..., used].reshape(-1, used.sum())
        normal = A.T @ A + np.diag(len(target) * alpha[used])
        weights = np.zeros(len(alpha))
        weights[used] = np.linalg.solve(normal, A.T @ target.ravel())
        return weights.reshape(n_arcs, n_inputs)

    def best(
        self, candidates: list[Penalties], columns: NDArray, target: NDArray, folds: list
    ) -> Penalties:
        """Return the penalties of least error on held-out groups."""
        errors = []
        for penalties in candidates:
            error = 0.0
            for train, test in folds:
                weights = self.solution(columns[train], target[train], penalties).ravel()
                error += np.square(target[test] - columns[test] @ weights).sum()
            errors.append(error)
        return candidates[int(np.argmin(errors))]

    def shift(self, y: NDArray, past: NDArray) -> NDArray:
        """Return by how much the past moves the tips of rows (N, m) [m]."""
        weights = self.units[:, None] * self.scaled
        inputs = self.inputs(y, past)
        with_past = self.arcs(y) + inputs @ weights.T
        inputs[:, self.n_linear :] = 0.0
        without = self.arcs(y) + inputs @ weights.T
        return self.tips(with_past)[0] - self.tips(without)[0]


def compared(log: Log, error_model: str) -> Iterator[tuple[str, float, float]]:
    """Yield for every fold and hysteresis its name, and the mean errors without and with history.

    Errors are those of the tip [mm].
    """
    past = log.behind()
    for train, test in GroupKFold(FOLDS).split(log.q, groups=log.groups):
        counted = np.flatnonzero(log.counts[train])
        counted = counted[:: max(1, round(len(counted) / MOST))]
        rows = train[counted]
        counts = np.zeros(len(train))
        counts[counted] = 1.0
        test = test[log.counts[test] > 0.0]
        x = log.x[rows]
        groups = log.groups[rows]
        geometry = choose_geometry(log.chain, log.q[rows], x, groups=groups)
        settings: dict[str, Any] = {"calibrate": geometry, "random_state": 0}
        mechanics = HybridForwardModel(log.chain, "drop", hysteresis="auto", **settings)
        mechanics.fit(log.commands(train), log.x[train], counts, groups=log.groups[train])
        coupling = "parallel" if error_model == "auto" else "serial"
        model = HybridForwardModel(log.chain, error_model, coupling=coupling, **settings)
        for name, hysteresis in {"none": Hysteresis(), "auto": mechanics.hysteresis_}.items():
            y = log.q
            if hysteresis:
                y = hysteresis.apply_by_group(log.q, log.runs, log.time)
            model.fit(y[rows], x, groups=groups)
            without = model.predict(y[test])
            chain = as_forward_model(model.mechanical_model_)
            history = History(chain, y[rows], past[rows], x, groups)
            model.fit(y[rows], x - history.shift(y[rows], past[rows]), groups=groups)
            with_past = model.predict(y[test]) + history.shift(y[test], past[test])
            yield name, tip_error(without, log.x[test]), tip_error(with_past, log.x[test])


def tip_error(predicted: NDArray, measured: NDArray) -> float:
    """Return the mean distance of tips, which are the last marker [mm]."""
    return 1e3 * float(np.linalg.norm((predicted - measured)[:, -3:], axis=1).mean())


def numbered(runs: NDArray) -> NDArray:
    """Return the number of every row in its run (N,)."""
    place = np.empty(len(runs))
    for run in np.unique(runs):
        of_run = runs == run
        place[of_run] = np.arange(of_run.sum())
    return place


def simulated(coupled: bool, seed: int = 0) -> Log:
    """Return a simulated trunk that creeps: 20 runs of 8 postures, each held for 6 rows of 2 s.

    What the segments do is q + sum_k B_k (a_k - q), with time constants of 5 and 25 s. Diagonal
    B_k are creep of the actuators, full ones are creep of a body that couples them. 0.5 mm of
    noise.
    """
    rng = np.random.default_rng(seed)
    n_runs = 20
    n_postures = 8
    n_held = 6
    postures = 0.25 + rng.uniform(-0.04, 0.04, (n_runs * n_postures, 9))
    q = np.repeat(postures, n_held, axis=0)
    runs = np.repeat(np.arange(n_runs), n_postures * n_held)
    seconds = 2.0 * numbered(runs)
    name = "simulated, full B_k" if coupled else "simulated, diagonal B_k"
    log = Log(name, TRUNK, q, q[:, :3], runs, seconds, runs, np.ones(len(q)))
    y = q.copy()
    for tau in (5.0, 25.0):
        B = np.diag(rng.uniform(0.05, 0.2, 9))
        if coupled:
            B = rng.normal(0.0, 0.05, (9, 9))
        y += (log.average(tau) - q) @ B.T
    y += 0.75 * (y[:, ::-1] - 0.25) ** 2
    with torch.no_grad():
        x = TRUNK(torch.from_numpy(y)).numpy()
    return log._replace(x=x + 5e-4 * rng.standard_normal(x.shape))


def logs(data_home: Path | None) -> Iterator[Log]:
    """Yield the recordings, then the simulated trunks."""
    for load in (asl_trunk, plain_ftdcr):
        robot = load(data_home)
        if robot is not None:
            _, chain, _, _, q, x, runs = robot
            yield Log(robot.name, chain, q, x, runs, numbered(runs), runs, np.ones(len(q)))
    try:
        arm = Recording(data_home)
    except FileNotFoundError as missing:
        warnings.warn(f"Left out: {missing}", stacklevel=2)
    else:
        rows = arm.q, arm.x, arm.runs, arm.time, arm.days
        yield Log("asu_bellows", nominal(), *rows, arm.rest.astype(float))
    yield simulated(coupled=False)
    yield simulated(coupled=True)


def main() -> None:
    """Print the table: errors in mm, and the gain by history, mean ± standard error of folds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--error-model", default="quadratic", choices=("quadratic", "auto"))
    options = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    print("| log | hysteresis | without history | with history | gain |\n" + 5 * "| --- " + "|")
    for log in logs(options.data):
        errors: dict[str, list[tuple[float, float]]] = {}
        for name, without, with_past in compared(log, options.error_model):
            errors.setdefault(name, []).append((without, with_past))
        for name, of_folds in errors.items():
            without, with_past = np.mean(of_folds, axis=0)
            gains = -np.diff(of_folds, axis=1)[:, 0]
            gain = f"{gains.mean():.2f} ± {gains.std(ddof=1) / np.sqrt(len(gains)):.2f}"
            line = log.name, name, f"{without:.2f}", f"{with_past:.2f}", gain
            print(f"| {' | '.join(line)} |", flush=True)
    print(f"\n{time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
