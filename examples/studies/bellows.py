"""An arm of two bellows segments driven by six pressures: errors at rest on days held out.

The table of the docs page "Results", section "Forces and pressures"::

    python examples/studies/bellows.py --jobs 2

It needs the recording asu_bellows in the folder that ``--data`` or HYBRIDKIN_DATA names
(`help(hybridkin.datasets.load_asu_bellows)` names its source). Every day is held out once; models
are fitted to rows at rest of the other days, hysteresis to whole runs. A day on which no chamber
was inflated is left out.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from hybridkin import Commands, ConstantCurvatureChain, HybridForwardModel, datasets

AT_REST = 4e-3  # [m] largest motion of the tip in half a second
EVERY = 10  # of the rows at rest is fitted: their neighbours are alike
EMPTY = "Jan_10-1"  # no chamber was inflated on that day
BAR = 1e5  # [Pa]
GEOMETRY = ("radii", "gains", "actuator_zeros", "base", "rest_bends", "offsets")

MODELS = {
    "mechanical, nominal": {"error_model": "drop", "calibrate": ["base"]},
    "mechanical, calibrated": {"error_model": "drop", "calibrate": GEOMETRY},
    "data-driven, quadratic": {},
    "hybrid, linear": {
        "error_model": "linear",
        "coupling": "serial",
        "calibrate": GEOMETRY,
    },
    "hybrid, quadratic": {
        "error_model": "quadratic",
        "coupling": "serial",
        "calibrate": GEOMETRY,
    },
    "hybrid, ELM": {"calibrate": GEOMETRY},
    "hybrid, auto": {"error_model": "auto"},
    "hybrid, quadratic, hysteresis": {
        "error_model": "quadratic",
        "coupling": "serial",
        "calibrate": GEOMETRY,
        "play": "auto",
    },
}


def nominal() -> ConstantCurvatureChain:
    """Return the arm before calibration: orders of magnitude, from no fit."""
    chain = ConstantCurvatureChain(
        [0.03, 0.03],
        gains=0.1,  # [m/bar]
        actuator_zeros=-1.0,  # [bar] 0.1 m long without pressure
        offsets=[0.022, 0.0],
        base=[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -0.037], [0, 0, 0, 1]],
    )
    return chain.with_markers([(0, 1.0), (1, 1.0)])


class Recording:
    """Pressures [bar], both markers [m], times [s], and which rows are at rest."""

    def __init__(self, data_home: Path | None) -> None:
        data = datasets.load_asu_bellows(data_home)
        used = data.day != EMPTY
        self.q = data.q[used] / BAR
        self.x = np.hstack([data.middle, data.x])[used]
        self.runs = data.groups[used]
        self.time = data.time[used]
        self.days = data.day[used]
        self.rest = np.zeros(len(self.q), dtype=bool)
        for run in np.unique(self.runs):
            rows = np.flatnonzero(self.runs == run)
            tips = self.x[rows, 3:]
            way = np.linalg.norm(tips[5:] - tips[:-5], axis=1)
            self.rest[rows[5:]] = way < AT_REST

    def predicted(self, name: str, day: str) -> NDArray:
        """Return predictions of a model fitted to the other days, for all rows of a day."""
        other = self.days != day
        counted = np.zeros(len(self.q))
        counted[np.flatnonzero(self.rest & other)[::EVERY]] = 1.0
        q_new = self.q[~other]
        fitted = counted > 0.0
        if name == "data-driven, quadratic":
            features = PolynomialFeatures(2, include_bias=False)
            penalties = RidgeCV(10.0 ** np.arange(-4, 4))
            model = make_pipeline(StandardScaler(), features, penalties)
            return model.fit(self.q[fitted], self.x[fitted]).predict(q_new)
        model = HybridForwardModel(nominal(), random_state=0, **MODELS[name])
        if model.hysteresis is None:
            model.fit(self.q[fitted], self.x[fitted], groups=self.days[fitted])
            return model.predict(q_new)
        commands = Commands(self.q, self.runs, self.time)
        model.fit(commands[other], self.x[other], counted[other], groups=self.days[other])
        return model.predict(commands[~other])

    def error(self, name: str, day: str) -> tuple[float, float, float]:
        """Return mean and largest tip error at rest on a day [mm], and processor time [s]."""
        start = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            predicted = self.predicted(name, day)
        here = self.days == day
        far = np.linalg.norm((predicted - self.x[here])[:, 3:], axis=1)
        far = 1e3 * far[self.rest[here]]
        return far.mean(), far.max(), time.process_time() - start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--models", nargs="+", default=[*MODELS])
    options = parser.parse_args()
    recording = Recording(options.data)
    days = np.unique(recording.days)
    print("| model | " + " | ".join(days) + " | median | seconds |")
    print("| --- " * (len(days) + 3) + "|")
    for name in options.models:
        run = Parallel(options.jobs)
        errors = np.array(run(delayed(recording.error)(name, day) for day in days))
        means = [f"{mean:.0f} ({most:.0f})" for mean, most, _ in errors]
        means += [f"{np.median(errors[:, 0]):.1f}", f"{errors[:, 2].mean():.0f}"]
        print(f"| {name} | " + " | ".join(means) + " |", flush=True)


if __name__ == "__main__":
    main()
