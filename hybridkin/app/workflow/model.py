"""Loading a model: a saved one, the folder of a fit, or a robot description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

import hybridkin
from hybridkin import (
    Chain,
    Commands,
    ForwardModel,
    Hysteresis,
    as_forward_model,
    robots,
)
from hybridkin._core.digests import row_digests
from hybridkin.app.workflow.errors import ExpectedErrors, HeldOutErrors, Promise
from hybridkin.arguments import as_path, shaped
from hybridkin.formats import UNITS, LogUnit, in_terms
from hybridkin.native import evaluate
from hybridkin.saving.header import model_header

if TYPE_CHECKING:
    from hybridkin import ELMRegressor, HybridForwardModel

LOG_SUFFIXES = (".csv", ".tsv", ".txt", ".npz", ".parquet", ".pq")
"""Endings of files that are treated as logs."""

_MODELS = (".toml", ".safetensors")
_MODEL = "model.safetensors"
_ROBOT = "robot.toml"
_HEADER = 8  # bytes of the size of the header of a model, which begins with a brace
_LONG = 1e9  # time after which all creep has come [s]


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A model q -> x, with its file and its robot description.

    Attributes
    ----------
    name : str
        Name in reports.
    path : Path
        The file.
    model : Chain, HybridForwardModel or ELMRegressor
        A chain or a fitted model.
    description : RobotDescription or None
        The robot description that was given or lies beside the model.
    header : dict or None
        Header of the file, see `model_header`; only for a saved model.
    """

    name: str
    path: Path
    model: Chain | HybridForwardModel | ELMRegressor
    description: robots.RobotDescription | None = None
    header: dict[str, Any] | None = None

    @property
    def hybrid(self) -> HybridForwardModel | None:
        """The model if it is a hybrid, else None."""
        if isinstance(self.model, Chain):
            return None  # at once: a chain does not load the hybrid
        if isinstance(self.model, hybridkin.HybridForwardModel):
            return self.model
        return None

    @property
    def chain(self) -> Chain | None:
        """The mechanical model if it is a chain, else None."""
        mechanical = self.model
        if self.hybrid is not None:
            mechanical = self.hybrid.mechanical_model_
        if isinstance(mechanical, Chain):
            return mechanical
        return None

    @property
    def module(self) -> ForwardModel:
        """The torch module q -> tip."""
        return as_forward_model(self.model).tip_model

    @property
    def n_actuators(self) -> int:
        """Size of q."""
        if self.hybrid is None:
            return self.module.n_actuators
        return self.hybrid.n_features_in_

    @property
    def trained_range(self) -> robots.Limits | None:
        """Training range: least and largest q of the fit, None if not known.

        With backlash it is the range of the actuators' motion.
        """
        if self.hybrid is None:
            return None
        return robots.Limits(*self.hybrid.training_range_)

    @property
    def hysteresis(self) -> Hysteresis:
        """The hysteresis of the actuators, maybe none."""
        if self.hybrid is None:
            return Hysteresis()
        return self.hybrid.hysteresis_

    @property
    def half_width(self) -> NDArray:
        """Half the width of the hysteresis, in the unit of q; 0 without."""
        return 0.5 * self.hysteresis.width

    @property
    def log_unit(self) -> LogUnit:
        """The unit of q in the logs of the robot."""
        return LogUnit.of(self.log_format().q_unit)

    @property
    def hysteresis_widths(self) -> list[float] | None:
        """Widths of the hysteresis of one or all actuators, in the unit of logs; None without."""
        if not self.hysteresis:
            return None
        size = UNITS.get(self.log_format().q_unit, 1.0)
        return np.ravel(self.hysteresis.width / size).tolist()

    def effective(self, commands: ArrayLike | Commands) -> NDArray:
        """Return what the actuators do for commands (N, n)."""
        checked = self._checked(commands)
        if self.hybrid is None:
            return checked.q
        return self.hybrid.effective(checked)

    def commands(self, q: NDArray, time: NDArray | None = None) -> NDArray:
        """Return the commands (N, n) that move the actuators along q (N, n), row after row.

        The times (N,) of the rows matter with creep [s]; without them the robot rests at each row.
        """
        steps = _LONG if time is None else np.diff(time, prepend=time[:1])
        commands, _ = self.hysteresis.command(q, dt=steps)
        return commands

    def predict(self, commands: ArrayLike | Commands) -> NDArray:
        """Return tips (N, 3) [m], or all markers, for commands (N, n)."""
        checked = self._checked(commands)
        if self.hybrid is not None:
            return self.hybrid.predict(checked)
        q = np.array(checked.q, dtype=float)
        return evaluate(as_forward_model(self.model), q)[0]

    def tips(self, q: NDArray) -> NDArray:
        """Return tips (N, 3) [m] for the motion q (N, n) of the actuators, without backlash."""
        return evaluate(self.module, np.array(q, dtype=float))[0]

    def domain_distance(self, q: NDArray) -> NDArray:
        """Return the distance of rows q (N, n) from the training rows, at most 1 in the domain."""
        q = np.array(q, dtype=float)
        return evaluate(self.module, q, value=False, distance=True)[0]

    def _checked(self, commands: ArrayLike | Commands) -> Commands:
        checked = Commands.of(commands)
        q = shaped(checked.q, "commands", ("N", self.n_actuators))
        if not len(q) or not np.isfinite(q).all():
            raise ValueError(
                "`commands` must be finite and hold at least one row, got "
                f"{np.isfinite(q).all(axis=1).sum()} finite ones of {len(q)}."
            )
        return checked

    def check_columns(self, q: NDArray) -> None:
        """Raise if the rows q (N, n) of a log do not have one column for each actuator."""
        if q.shape[1] != self.n_actuators:
            raise ValueError(
                f"`q` must name {self.n_actuators} columns, one for each actuator of the model, "
                f"got {q.shape[1]}."
            )

    def was_fitted(
        self, q: NDArray, x: NDArray, motions: NDArray
    ) -> NDArray[np.bool_] | None:
        """Return whether each row (N,), to a micrometre, or half of its motion was fitted.

        None if the model does not hold its rows.
        """
        if self.hybrid is None:
            # Nominal: no fit.
            return None if self.header else np.zeros(len(q), dtype=bool)
        fitted = np.isin(row_digests(q, x), self.hybrid._fit.fitted_rows)
        _, motion = np.unique(motions, return_inverse=True)
        half_fitted = np.bincount(motion, fitted) >= 0.5 * np.bincount(motion)
        return fitted | half_fitted[motion]

    @property
    def training(self) -> dict[str, Any]:
        """The notes of the fit in the file; empty without."""
        return (self.header or {}).get("training") or {}

    @property
    def held_out(self) -> HeldOutErrors | None:
        """Errors of the fit on held-out motions, where the file has them."""
        held_out = self.training.get("held_out", {})
        entry = held_out.get(self.training.get("saved"))
        if entry is None:
            return None
        return HeldOutErrors.read(entry)

    @property
    def kind(self) -> str:
        """What the model is, as the fit calls it: "hybrid, ELM", "mechanical, nominal", ..."""
        kind = "hybrid"
        if self.hybrid is None:
            kind = "data-driven"
            if self.chain is not None:
                kind = "mechanical, nominal"
        return self.training.get("saved", kind)

    def promised_errors(self, q: NDArray) -> ExpectedErrors | None:
        """Return the errors (N,) to expect where the actuators do q (N, n).

        They are those of held-out motions at the same distance from the log. None if the file does
        not have them.
        """
        if self.hybrid is None or "promise" not in self.training:
            return None
        promise = Promise(**self.training["promise"])
        tested = self.hybrid.fitted_module_.tested
        if tested is None:
            return promise.at(np.zeros(len(q)))
        moved = torch.from_numpy(q + self.hybrid.change_.shift)
        return promise.at(tested.distances(moved).numpy())

    def expected_errors(self, q: NDArray) -> dict[str, NDArray]:
        """Return by name the errors (N,) [m] to expect of the robot where the actuators do q."""
        expected = {}
        promised = self.promised_errors(q)
        if promised is not None:
            expected["held-out motions, mean"] = promised.mean
            expected["held-out motions, 95 %"] = promised.p95
        if self.hybrid is not None and self.hybrid.radius_ is not None:
            radius = self.hybrid.radius_
            name = f"estimated error radius, {100 * radius.coverage:g} %"
            expected[name] = radius.at(self.domain_distance(q) <= 1.0)
        return expected

    def plane_in_words(self) -> str:
        """Return which motions the log lacks and no command makes, in its names; "" if none."""
        if self.module.plane is None:
            return ""
        log = self.log_format()
        normals = self.module.plane[1].numpy(force=True) * np.reshape(
            log.q_factor, (-1, 1)
        )
        motions = in_terms(normals / np.abs(normals).max(axis=0), log.q)
        return (
            f"The log has no motion along {motions}, and the mechanical model knows no effect of "
            "it: commands keep to what the log has."
        )

    def log_format(self) -> robots.LogFormat:
        """Return the format of the robot's logs, or plain names in SI units."""
        if self.description is not None and self.description.log is not None:
            return self.description.log
        names = tuple(f"q{i + 1}" for i in range(self.n_actuators))
        unit = "m" if self.module.robot.in_metres else "1"
        return robots.LogFormat(names, ("x", "y", "z"), unit)


def is_log(path: str | Path) -> bool:
    """Return whether a path names a log: by its ending, else a file that is no model.

    Parameters
    ----------
    path : str or Path
        A file, or a folder of a fit.

    Returns
    -------
    bool
        Files without a known ending are logs if they do not begin like a model.
    """
    path = as_path(path)
    if path.suffix.lower() in LOG_SUFFIXES:
        return True
    if path.suffix.lower() in _MODELS or not path.is_file():
        return False
    with open(path, "rb") as file:
        start = file.read(_HEADER + 1)
    return start[_HEADER:] != b"{"


def open_model(path: str | Path, robot: str | Path | None = None) -> LoadedModel:
    """Return the model that a path names.

    Parameters
    ----------
    path : str or Path
        A saved model, a folder that `fit_log` wrote, or a robot description (TOML), which gives
        its nominal chain.
    robot : str or Path, optional
        Robot description, for the format of its logs and its limits. Default: ``robot.toml`` in
        the folder of the model.

    Returns
    -------
    LoadedModel
        The model, with its header and its robot description.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not a model, or not one of that robot.
    """
    path = as_path(path)
    if path.suffix.lower() == ".toml":
        description = robots.read_description(path)
        if description.chain is None:
            raise ValueError(
                f"`model` {path} describes a robot without segments. It has no model before a "
                f"fit: hybridkin fit LOG --robot {path} --out MODEL."
            )
        return LoadedModel(description.name, path, description.chain, description)
    if path.suffix.lower() in LOG_SUFFIXES:
        raise ValueError(
            f"`model` must be a model or a robot description, got the log {path}."
        )
    if path.is_dir():
        path = path / _MODEL
    model = hybridkin.load_model(path)
    beside = path.with_name(_ROBOT)
    if robot is None and path.name == _MODEL and beside.is_file():
        robot = beside
    if robot is None:
        return LoadedModel(path.stem, path, model, header=model_header(path))
    description = robots.read_description(robot)
    loaded = LoadedModel(description.name, path, model, description, model_header(path))
    if description.n_actuators not in (0, loaded.n_actuators):
        raise ValueError(
            f"`robot` {description.name!r} has {description.n_actuators} actuators, but the model "
            f"{path} has {loaded.n_actuators}; give the description that it was fitted with."
        )
    return loaded
