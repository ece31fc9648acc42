"""How much of the errors on held-out motions is static, hysteresis, and not repeatable."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hybridkin import HybridForwardModel
from hybridkin.app.workflow.compare import AUTO, CALIBRATED
from hybridkin.app.workflow.errors import HeldOutErrors
from hybridkin.app.workflow.log import MeasuredLog
from hybridkin.app.workflow.report import millimetres
from hybridkin.datasets import repeatability


def explained_in_words(
    held_out: Mapping[str, HeldOutErrors], rows: MeasuredLog, model: HybridForwardModel
) -> str:
    """Return what functions of q and hysteresis explain of a log, and what neither can.

    Parameters
    ----------
    held_out : dict of str to HeldOutErrors
        Errors of every model on held-out motions.
    rows : MeasuredLog
        The fitted rows, and those that only move the actuators.
    model : HybridForwardModel
        The model that is fitted to them.
    """
    static = {}
    for name, errors in held_out.items():
        of_q = name.startswith("data-driven") or name == CALIBRATED
        if of_q or not model.follows_order:
            static[name] = errors.mean
    best = min(static, key=static.__getitem__)
    words = (
        f"Of the errors on held-out motions, the best function of q ({best}) leaves "
        f"{millimetres(static[best])}"
    )
    if model.hysteresis_:
        words += f", and {AUTO}, with hysteresis, {millimetres(held_out[AUTO].mean)}"
    log = rows.measured
    x = log.x[:, -3:]
    measured = np.isfinite(x).all(axis=1)
    inputs = {"functions of q": log.q}
    if model.hysteresis_:
        moved = model.effective(rows.commands)[rows.counted]
        inputs["those of what the actuators do"] = moved
    for name, q in inputs.items():
        floor = repeatability(q[measured], x[measured], log.motions[measured])
        least = "cannot be told from this log"
        if floor is not None:
            least = f"is about {millimetres(floor)}"
        words += f"; the least error of {name} {least}"
    return f"{words}. The rest is noise, drift, and what q does not say of the past."
