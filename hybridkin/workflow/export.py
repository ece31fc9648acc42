"""A model as C code for a controller, with a step of inverse kinematics if requested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hybridkin.ik.solver import InverseKinematics
from hybridkin.native.export import export_c
from hybridkin.workflow.domain import Domain, PathLimits, path_limits
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import Report


def export_model(
    loaded: LoadedModel,
    out: str | Path,
    *,
    name: str = "model",
    dtype: str = "float64",
    dt: float | None = None,
    limits: PathLimits | None = None,
) -> tuple[Report, list[Path]]:
    """Write a model as C code, see `native.export_c`.

    Parameters
    ----------
    loaded : LoadedModel
        The model, as from `open_model`.
    out : str or Path
        Folder to write into.
    name : str, default="model"
        Name of the files and functions.
    dtype : {"float64", "float32"}, default="float64"
        Number type of the code.
    dt : float, optional
        Control period [s]. If given, a step of inverse kinematics is written, too; it prefers a
        configuration in the domain of the model. Default: the model alone.
    limits : PathLimits, optional
        Limits of the step. Default: `path_limits`.

    Returns
    -------
    report : Report
        Its ``record`` holds "n_actuators", "dtype", "dt", and with a step "limits".
    paths : list of Path
        The written files.
    """
    report = Report("C code")
    model = loaded.module
    report.record.update(n_actuators=loaded.n_actuators, dtype=dtype, dt=dt)
    report.text(f"{name}: {loaded.n_actuators} actuators, {dtype}.")
    if dt is not None:
        if limits is None:
            limits = path_limits(loaded)
        settings: dict[str, Any] = {
            k: v for k, v in vars(limits).items() if k != "source"
        }
        settings |= {"q_pref": Domain(loaded, limits).preferred}
        model = InverseKinematics(loaded.module, dt=dt, **settings)
        report.record["limits"] = vars(limits)
        report.text(f"Steps of {dt:g} s within limits: {limits.source}.")
    about_q = _about_q(loaded)
    report.text(about_q)
    return report, export_c(model, out, name=name, dtype=dtype, about_q=about_q)


def _about_q(loaded: LoadedModel) -> str:
    """Return unit, sign and backlash of q in sentences, as a controller must know them."""
    log = loaded.log_format()
    factors = np.broadcast_to(log.q_factor, len(log.q))
    rows = zip(factors, log.q, strict=True)
    terms = ", ".join(
        f"q[{i}] = {factor:g} * {name}" for i, (factor, name) in enumerate(rows)
    )
    unit = "" if log.q_unit == "1" else f" in {log.q_unit}"
    about_q = f"q from the columns of the log{unit}: {terms}."
    if loaded.play is None:
        return about_q
    return (
        f"{about_q} The robot has backlash (play) of {loaded.play.width.tolist()}, in the unit of "
        "q, for which this code does not compensate: q is the motion of the actuators, and "
        "`PlayOperator.command` in Python shows the commands to send."
    )
