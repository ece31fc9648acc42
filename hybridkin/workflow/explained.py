"""How much of the errors on held-out motions is static, hysteresis, and not repeatable."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hybridkin.datasets import repeatability
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.workflow.compare import AUTO, CALIBRATED
from hybridkin.workflow.errors import HeldOutErrors
from hybridkin.workflow.log import MeasuredLog
from hybridkin.workflow.report import millimetres


def explained_in_words(
    held_out: Mapping[str, HeldOutErrors], rows: MeasuredLog, model: HybridForwardModel
) -> str:
    """Return what functions of q and hysteresis explain of a log, and what neither can.

    Parameters
    ----------
    held_out : dict of str to HeldOutErrors
        Errors of every model on held-out motions.
    rows : MeasuredLog
        The fitted rows.
    model : HybridForwardModel
        The model that is fitted to them.
    """
    static = {}
    for name, errors in held_out.items():
        if model.play is None or name.startswith("data-driven") or name == CALIBRATED:
            static[name] = errors.mean
    best = min(static, key=static.__getitem__)
    words = "Mean errors on held-out motions: "
    if CALIBRATED in static and best != CALIBRATED:
        words += f"{CALIBRATED} {millimetres(static[CALIBRATED])}; "
    words += f"best function of q ({best}) {millimetres(static[best])}"
    if model.play_ is not None:
        words += f"; with hysteresis ({AUTO}) {millimetres(held_out[AUTO].mean)}"
    x = rows.x[:, -3:]
    measured = np.isfinite(x).all(axis=1)
    tips = x[measured], rows.motions[measured]
    floor = repeatability(rows.q[measured], *tips)
    if floor is None:
        return (
            f"{words}. The least possible error is not known: too few rows are close to rows of "
            "other motions."
        )
    words += (
        f". Where motions meet at nearly the same q, their tips differ: no function of q can have "
        f"an error below about {millimetres(floor)}"
    )
    if model.play_ is not None:
        left = repeatability(model.effective(rows.commands)[measured], *tips)
        if left is not None:
            words += f", none of what the actuators do below {millimetres(left)}"
    return f"{words}. This rest is noise, drift, or what the model does not know of the past."
