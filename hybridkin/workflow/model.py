"""A model to work with: a saved one, the folder of a fit, or a robot description."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hybridkin import datasets, robots
from hybridkin.chains.play import PlayOperator
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.saving.saved_model import load_model, model_header

_MODEL, _ROBOT = "model.safetensors", "robot.toml"


class OpenedModel(NamedTuple):
    """A model q -> x with all that is known of it.

    Parameters
    ----------
    name : str
        What to call it.
    path : Path
        The file.
    model : nn.Module or estimator
        A chain, a fitted hybrid or a fitted ELM.
    description : RobotDescription or None
        The robot's, where it stood beside the model or was given.
    header : dict or None
        What the file says of the model, see `persistence.model_header`; of a saved model only.
    """

    name: str
    path: Path
    model: Any
    description: robots.RobotDescription | None
    header: dict[str, Any] | None

    @property
    def is_hybrid(self) -> bool:
        """Whether it is a fitted hybrid model."""
        return hasattr(self.model, "mechanical_model_")

    @property
    def chain(self) -> Any:
        """The mechanical part, or None."""
        if self.is_hybrid:
            return self.model.mechanical_model_
        return self.model if isinstance(self.model, nn.Module) else None

    @property
    def n_actuators(self) -> int:
        """Size of q."""
        if isinstance(self.model, nn.Module):
            return int(self.model.n_actuators)  # pyright: ignore[reportArgumentType]
        return int(self.model.n_features_in_)

    @property
    def module(self) -> Any:
        """The torch module q -> x."""
        return self.model if isinstance(self.model, nn.Module) else self.model.module_

    @property
    def trained_range(self) -> tuple[NDArray, NDArray] | None:
        """Least and largest q of the fit (n,), where the model knows them.

        With play it is that of what the actuators did.
        """
        drift = getattr(self.model, "_drift", None)
        if drift is None:
            return None
        half = np.where(drift.scale == 1.0, 0.0, drift.scale)  # one that never moved counts as 1
        return drift.center - half, drift.center + half

    @property
    def play(self) -> PlayOperator | None:
        """The play of the actuators, where the model has some."""
        return getattr(self.model, "play_", None)

    def effective(self, q: NDArray, groups: NDArray | None = None) -> NDArray:
        """Return what the actuators do (N, n) at commands q, of one motion or by motion."""
        if self.play is None:
            return q
        return self.play.apply_by_group(q, np.zeros(len(q)) if groups is None else groups)

    def predict(self, q: NDArray, groups: NDArray | None = None) -> NDArray:
        """Return tips (N, 3) [m]; with play by `groups`, the motion of every row."""
        if self.is_hybrid:
            return self.model.predict(q, groups=groups)
        if not isinstance(self.model, nn.Module):
            return self.model.predict(q)
        with torch.no_grad():
            return self.model(torch.from_numpy(np.ascontiguousarray(q))).numpy()

    def in_domain(self, q: NDArray, groups: NDArray | None = None) -> NDArray | None:
        """Return where the error model is trusted (N,), None without one."""
        return self.model.in_domain(q, groups=groups) if self.is_hybrid else None

    def log_format(self) -> robots.LogFormat:
        """Return how the robot's logs are written, or plain names in SI units."""
        if self.description is not None and self.description.log is not None:
            return self.description.log
        names = tuple(f"q{i + 1}" for i in range(self.n_actuators))
        return robots.LogFormat(names, ("x", "y", "z"))


def open_model(path: str | Path, robot: str | Path | None = None) -> OpenedModel:
    """Return the model that a path names.

    Parameters
    ----------
    path : str or Path
        A saved model, a folder that `fit_log` wrote, or a robot description (TOML), which stands
        for its nominal chain.
    robot : str or Path, optional
        Robot description, for the format of its logs and its limits. Default: ``robot.toml`` in
        the folder of the model.

    Returns
    -------
    OpenedModel
        The model, with what is known of it.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no model, or not one of that robot.
    """
    path = Path(path)
    if path.suffix.lower() == ".toml":
        description = robots.read_description(path)
        return OpenedModel(description.name, path, description.chain, description, None)
    if path.is_dir():
        if not (path / _MODEL).is_file():
            raise FileNotFoundError(f"`model` {path} is a folder without {_MODEL}; name the file.")
        path = path / _MODEL
    model, beside = load_model(path), path.parent
    description = None
    if robot is not None:
        description = robots.read_description(robot)
    elif path.name == _MODEL and (beside / _ROBOT).is_file():
        description = robots.read_description(beside / _ROBOT)
    name = path.stem if description is None else description.name
    opened = OpenedModel(name, path, model, description, model_header(path))
    if description is not None and description.chain.n_actuators != opened.n_actuators:
        raise ValueError(
            f"`robot` {description.name!r} has {description.chain.n_actuators} actuators, the "
            f"model {path} has {opened.n_actuators}; give the description it was fitted with."
        )
    return opened


def trunk_model() -> OpenedModel:
    """Return the paper's: a hybrid of the trunk's nominal chain and an ELM, fitted to its data.

    Returns
    -------
    OpenedModel
        With the trunk's limits; its data are the simulated ones of `datasets.load_trunk`.
    """
    data = datasets.load_trunk()
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, random_state=0).fit(data.q, data.x)
    low, high = (np.full(chain.n_actuators, bound) for bound in robots.BHA_LENGTH_LIMITS)
    description = robots.RobotDescription(
        "simulated trunk", chain, (), None, robots.Limits(low, high)
    )
    return OpenedModel("simulated trunk, hybrid ELM", Path("trunk"), model, description, None)
