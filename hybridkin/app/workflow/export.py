"""A model in C, for MATLAB or as a functional mock-up unit, with a step if requested."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybridkin import HybridForwardModel, obstacles
from hybridkin.app.workflow.domain import Domain, PathLimits, path_limits
from hybridkin.app.workflow.model import hysteresis_in_words
from hybridkin.app.workflow.report import Report, millimetres
from hybridkin.app.workflow.surroundings import Surroundings
from hybridkin.arguments import one_of
from hybridkin.native import export_c, export_fmu, export_mex

_TITLES = {
    "c": "C code",
    "fmu": "Functional mock-up unit",
    "mex": "MATLAB and Octave",
}
# How an entry of q is written, and the number of the first one.
_ENTRIES = {"c": ("q[{}]", 0), "fmu": ("q[{}]", 1), "mex": ("q({})", 1)}


def export_model(
    model: HybridForwardModel,
    out: str | Path,
    *,
    kind: str = "c",
    name: str = "model",
    dtype: str = "float64",
    dt: float | None = None,
    limits: PathLimits | None = None,
    obstacles: Sequence[obstacles.Obstacle] = (),
    clearance: float = 0.0,
    force: bool = False,
) -> Report[dict[str, object]]:
    """Write a model as C code, see `native.export_c`.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.
    out : str or Path
        Folder to write into; of a functional mock-up unit the file.
    kind : {"c", "fmu", "mex"}, default="c"
        C code, a functional mock-up unit, or C code for MATLAB and Octave.
    name : str, default="model"
        Name of the files and functions.
    dtype : {"float64", "float32"}, default="float64"
        Number type of C code.
    dt : float, optional
        Control period [s]. If given, a step of inverse kinematics is written, too; it prefers a
        configuration in the domain of the model. Default: the model alone.
    limits : PathLimits, optional
        Limits of the step. Default: `path_limits`.
    obstacles : sequence of Obstacle, default=()
        What the whole body keeps clear of in the step, from `hybridkin.obstacles`; needs `dt`.
    clearance : float, default=0.0
        Least distance between body and obstacles [m].
    force : bool, default=False
        Replace files that `export` did not write.

    Returns
    -------
    Report of dict
        Number type "dtype", control period "dt" [s] and "limits" of the step, and names of the
        "obstacles".
    """
    one_of(kind, "kind", _TITLES)
    if kind != "c" and dtype != "float64":
        raise ValueError('`dtype` must be "float64" here; "float32" is for C code.')
    surroundings = Surroundings(obstacles, clearance)
    if surroundings and dt is None:
        raise ValueError("`obstacles` need `dt` (--dt): they are limits of the step.")
    record: dict[str, object] = {"dtype": dtype, "dt": dt, "obstacles": surroundings.names}
    report = Report(_TITLES[kind], record)
    report.text(f"{name}: {model.n_features_in_} actuators, {dtype}.")
    exported = model.module_.tip_model
    if dt is not None:
        limits = limits or path_limits(model)
        exported = Domain(model, limits, surroundings).solver(dt=dt)
        record["limits"] = limits
        report.text(f"Steps of {dt:g} s within limits: {limits.source}.")
    if surroundings:
        report.text(
            f"The body keeps {millimetres(clearance)} clear of {{names}}.",
            names=", ".join(surroundings.names),
        )
    about_q = _about_q(model, _ENTRIES[kind])
    report.text("{about_q}", about_q=about_q)
    words = {"name": name, "about_q": about_q}
    if kind == "fmu":
        report.paths = [export_fmu(exported, out, **words, force=force)]
    elif kind == "mex":
        report.paths = export_mex(exported, out, **words, force=force)
    else:
        report.paths = export_c(exported, out, dtype=dtype, **words, force=force)
    return report


def _about_q(model: HybridForwardModel, entry: tuple[str, int]) -> str:
    """Return unit, sign and hysteresis of q in sentences, as a controller must know them.

    `entry` is how its language names an entry of q, and the number of the first one.
    """
    form, first = entry
    log = model.description_.log
    factors = np.broadcast_to(log.q_factor, len(log.q))
    terms = []
    for i, name in enumerate(log.q):
        factor = "" if factors[i] == 1.0 else f"{factors[i]:g} * "
        terms.append(f"{form.format(first + i)} = {factor}{name}")
    unit = "" if log.q_unit == "1" else f" in {log.q_unit}"
    about_q = f"q from the columns of the log{unit}: {', '.join(terms)}."
    if not model.hysteresis_:
        return about_q
    return (
        f"{about_q} The actuators have {hysteresis_in_words(model)}: x(q) is that of "
        "what the actuators do; steps return commands for it."
    )
