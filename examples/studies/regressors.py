"""How long a control step takes with error models of scikit-learn.

The table of "Control steps" on the page of benchmarks::

    python examples/studies/regressors.py --csv docs/data/speed_regressors.csv

A minute on one core. Hybrids of the simulated trunk with 9 chambers, fitted to 300 rows, follow a
target that moves by half a millimetre from step to step. The least CPU time of 25 steps counts.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import warnings
from typing import Any

import numpy as np
import torch
from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from sklearn.svm import SVR

from hybridkin import ELMRegressor, HybridForwardModel, InverseKinematics, datasets, robots

N_ROWS = 300
N_STEPS = 25
REGRESSORS = {
    "`LinearRegression`": LinearRegression(),
    "`ELMRegressor`": ELMRegressor(random_state=0),
    "`KernelRidge` with an RBF kernel, scaled": make_pipeline(
        StandardScaler(), KernelRidge(kernel="rbf", alpha=0.1, gamma=0.1)
    ),
    "`MLPRegressor`, 100 neurons": MLPRegressor(max_iter=500, random_state=0),
    "squares and products, `LinearRegression`": make_pipeline(
        PolynomialFeatures(2), LinearRegression()
    ),
    "`KNeighborsRegressor`": KNeighborsRegressor(),
    "`GaussianProcessRegressor`, scaled": make_pipeline(
        StandardScaler(), GaussianProcessRegressor(RBF(3.0) + WhiteKernel(0.1))
    ),
    "`SVR` for each axis, scaled": make_pipeline(StandardScaler(), MultiOutputRegressor(SVR())),
    "`HistGradientBoostingRegressor` for each axis": MultiOutputRegressor(
        HistGradientBoostingRegressor(random_state=0)
    ),
    "`RandomForestRegressor`, 100 trees": RandomForestRegressor(random_state=0),
}


def step_time(regressor: Any) -> tuple[float, str]:
    """Return the least CPU time of a step [s], and what computes it."""
    data = datasets.load_trunk()
    rows = np.flatnonzero(data.part == 3)[:N_ROWS]
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, regressor, calibrate="default")
    model.fit(data.q[rows], data.x[rows])
    ik = InverseKinematics(model, q_min=0.1, q_max=0.4, dt=0.01)
    tracker = ik.tracker(data.q[rows[0]])
    start = model.predict(data.q[rows[:1]])[0]
    times = []
    for k in range(N_STEPS):
        before = time.process_time()
        tracker.step(start + 0.0005 * k)
        times.append(time.process_time() - before)
    return min(times), tracker.backend.partition(":")[0]


def main() -> None:
    """Write the table into the file of the arguments, or onto the terminal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--csv", type=argparse.FileType("w"), default=sys.stdout)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of trees, which have no slope
    table = csv.writer(arguments.csv, lineterminator="\n")
    table.writerow(["error model", "computed by", "CPU time of a step [ms]"])
    for name, regressor in REGRESSORS.items():
        seconds, backend = step_time(regressor)
        table.writerow([name, backend, f"{1e3 * seconds:.2g}"])


if __name__ == "__main__":
    main()
