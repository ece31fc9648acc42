"""A model as C code for a controller, with a step of inverse kinematics if requested."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hybridkin.ik.solver import InverseKinematics
from hybridkin.native.export import export_c
from hybridkin.workflow._domain import Domain, PathLimits, path_limits
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
    report, model = Report("C code"), loaded.module
    report.record.update(n_actuators=loaded.n_actuators, dtype=dtype, dt=dt)
    report.text(f"{name}: {loaded.n_actuators} actuators, {dtype}, SI units.")
    if dt is not None:
        limits = path_limits(loaded) if limits is None else limits
        settings: dict[str, Any] = {k: v for k, v in vars(limits).items() if k != "source"}
        settings |= {"q_pref": Domain(loaded, limits).preferred, "beta": min(1.0, 1.0 / dt)}
        model = InverseKinematics(loaded.module, dt=dt, **settings)
        report.record["limits"] = vars(limits)
        report.text(f"Steps of {dt:g} s within limits: {limits.source}.")
    if loaded.play is not None:
        report.text(
            "This robot has backlash (play), and q in the code is the motion of the actuators. "
            "`PlayOperator.command` gives the commands to send."
        )
    return report, export_c(model, out, name=name, dtype=dtype)
