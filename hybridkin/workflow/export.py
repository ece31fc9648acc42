"""A model as C code for a controller, with the step of its inverse kinematics where asked for."""

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
        Of the files and functions.
    dtype : {"float64", "float32"}, default="float64"
        Numbers that the code computes with.
    dt : float, optional
        Control period [s]. With it the step of inverse kinematics is written too, drawn to a
        configuration in the domain of the model. Default: the model alone.
    limits : PathLimits, optional
        What the step keeps to. Default: `path_limits`.

    Returns
    -------
    report : Report
        Its ``record`` holds "n_actuators", "dtype", "dt", and "limits" where there is a step.
    paths : list of Path
        The files.
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
            "This robot has play, and q of the code are the values after it: what to send follows "
            "from `PlayOperator.command`."
        )
    return report, export_c(model, out, name=name, dtype=dtype)
