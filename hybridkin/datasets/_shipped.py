"""The shipped data of the simulated trunk, and the paper's split of them."""

from __future__ import annotations

import inspect
import json
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import Bunch

from hybridkin._core.arrays import random_generator, shaped, whole

_PAPER = (
    "R. F. Reinhart and J. J. Steil, Hybrid Mechanical and Data-driven Modeling Improves Inverse "
    "Kinematic Control of a Soft Robot, Procedia Technology 26, 12-19, 2016."
)


def load_trunk() -> Bunch:
    """Return the shipped simulated data of a pneumatic trunk: 2000 rows of the paper's protocol.

    The rows are chamber lengths and tip positions of a MuJoCo model similar to Festo's Bionic
    Handling Assistant, sampled by the protocol of Reinhart and Steil (2016): 3 x 500 rows in which
    one segment moves and 500 random ones. All data are simulated, not measured on a robot, with
    1 mm noise of the lengths and 0.5 mm of the tip. ``make_trunk(random_state=0)`` of the folder
    examples/paper of the repository made them. Loading does not need MuJoCo.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (2000, 9), measured chamber lengths [m], three per segment from base to tip; ``x``
        (2000, 3), measured tip position in the motion-capture frame [m]; ``q_target`` (2000, 9),
        commanded chamber lengths [m]; ``part`` (2000,), 0, 1 or 2 if only that segment moves, 3 if
        all lengths are random; ``row`` (2000,), row of the sampling protocol; ``groups`` (None);
        ``failed``, rows that did not settle, none; ``parameters``, seed, noise, sampling and plant
        parameters; ``units``, ``source``, ``citation``, ``DESCR``.

    Examples
    --------
    >>> from hybridkin.datasets import load_trunk
    >>> data = load_trunk()
    >>> data.q.shape, data.x.shape
    ((2000, 9), (2000, 3))
    """
    with (
        as_file(files("hybridkin.datasets") / "data" / "trunk.npz") as path,
        np.load(path) as file,
    ):
        columns = {name: file[name] for name in ("q", "x", "q_target", "part")}
        parameters = json.loads(str(file["parameters"]))
    return Bunch(
        **columns,
        row=np.arange(len(columns["q"])),
        groups=None,
        failed=[],
        parameters=parameters,
        units={"q": "m", "x": "m"},
        source="simulated by TrunkPlant of examples/paper, in the repository of hybridkin",
        citation=_PAPER,
        DESCR=inspect.getdoc(load_trunk),
    )


def paper_split(
    data: Any,
    random_state: int | np.random.Generator | None = None,
    *,
    n_test: int = 100,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the paper's split: test rows among the fully random ones, all others for training.

    Parameters
    ----------
    data : Bunch or array-like of shape (n_samples,)
        Data with ``part``, or that array itself.
    random_state : int, Generator or None, default=None
        Seed that selects the test rows among the fully random ones.
    n_test : int, default=100
        Number of rows of the test set.

    Returns
    -------
    train_idx : ndarray of shape (n_samples - n_test,)
        Training rows: all rows in which one segment moves alone, and the other random rows.
    test_idx : ndarray of shape (n_test,)
        Test rows.

    References
    ----------
    Reinhart and Steil (2016), section 3.3.

    Examples
    --------
    >>> from hybridkin.datasets import load_trunk, paper_split
    >>> train_idx, test_idx = paper_split(load_trunk(), random_state=0)
    >>> len(train_idx), len(test_idx)
    (1900, 100)
    """
    part = getattr(data, "part", data)
    if part is None:
        raise ValueError("`data` has no parts of the paper's protocol; give data of `load_trunk`.")
    part = shaped(part, "data", ["n_samples"])
    random_rows = np.flatnonzero(part == 3)
    n_test = whole(n_test, "n_test", 1, len(random_rows))
    rng = random_generator(random_state)
    test_idx = np.sort(rng.permutation(random_rows)[:n_test])
    return np.setdiff1d(np.arange(len(part)), test_idx), test_idx
