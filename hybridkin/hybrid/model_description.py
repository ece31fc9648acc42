"""What is known of a fitted model besides its predictions: its robot, its log and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybridkin._core.model import ForwardModel
from hybridkin.chains.robots import Limits, LogFormat, RobotDescription

__all__ = ["ModelDescription"]


@dataclass(frozen=True, eq=False)
class ModelDescription:
    """What is known of a fitted model besides its predictions.

    Attributes
    ----------
    robot : RobotDescription
        The robot, as described in the file beside the model; else a name alone.
    path : Path
        The file of the model; empty for a model in memory.
    training : mapping of str to Any
        The notes of the fit in the file, see `save_model`; empty without.
    created : str
        Date of the file of the model; empty for a nominal model, which no file of a fit holds.
    versions : mapping of str to str
        Versions of the packages that wrote the file.
    names : tuple of str
        Names of the actuators, where no description of the robot names columns.
    unit : {"m", "1"}
        Their unit there.
    """

    robot: RobotDescription
    path: Path = Path()
    training: Mapping[str, Any] = field(default_factory=dict)
    created: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    unit: str = "m"

    @classmethod
    def of(cls, model: ForwardModel, n_actuators: int) -> ModelDescription:
        """Return what a model in memory says of itself."""
        robot = RobotDescription(type(model.robot).__name__, None, (), None)
        names = tuple(f"q{i + 1}" for i in range(n_actuators))
        return cls(robot, names=names, unit="m" if model.robot.in_metres else "1")

    @property
    def name(self) -> str:
        """Name of the robot, or of the file."""
        return self.robot.name

    @property
    def log(self) -> LogFormat:
        """Format of the logs of the robot; plain names in SI units if nobody described it."""
        if self.robot.log is not None:
            return self.robot.log
        return LogFormat(self.names, ("x", "y", "z"), q_unit=self.unit)

    @property
    def limits(self) -> Limits:
        """Limits of the actuators, as far as described."""
        return self.robot.limits
