"""A described robot where a log saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridkin import GeometryChoice, HybridForwardModel, open_model
from hybridkin.app.workflow.model import is_fitted
from hybridkin.datasets import Log

_MOST_ROWS = 500  # of a log, for a base


def with_fitted_base(model: HybridForwardModel, log: Log) -> HybridForwardModel:
    """Return the model of a robot description with its base fitted to a log.

    A fitted model, a chain and a base that is known stay where they are, and so does a robot whose
    log has fewer than three complete rows.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.
    log : Log
        Measured rows.
    """
    robot = model.description_.robot
    chain = robot.chain
    if is_fitted(model) or not robot.path or chain is None or not robot.base_is_free:
        return model
    complete = np.isfinite(log.q).all(axis=1) & np.isfinite(log.x).all(axis=1)
    rows = np.flatnonzero(complete)
    rows = rows[:: 1 + len(rows) // _MOST_ROWS]
    if len(rows) < 3:
        return model
    placed = GeometryChoice(chain, ("base",)).fitted(log.q[rows], log.x[rows])
    opened = open_model(placed)
    described = replace(robot, chain=placed)
    return opened.described(replace(model.description_, robot=described))
