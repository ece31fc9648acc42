"""A model of a file, of the folder of a fit, or of a robot description, with what describes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin.chains.robots import RobotDescription, read_description
from hybridkin.datasets.table_files import LOG_SUFFIXES
from hybridkin.hybrid.description import nominal_hybrid
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.hybrid.model_description import ModelDescription
from hybridkin.saving._file import MODEL, model_path
from hybridkin.saving.header import model_header
from hybridkin.saving.saved_model import load_model

__all__ = ["open_model"]

_ROBOT = "robot.toml"


def open_model(
    model: str | Path | ForwardModel, robot: str | Path | None = None
) -> HybridForwardModel:
    """Return a model as a fitted estimator, with what is known of its robot, log and file.

    Parameters
    ----------
    model : str, Path or ForwardModel
        A file that `save_model` wrote, a folder with a ``model.safetensors``, as `hybridkin fit`
        writes it, or a robot description (TOML), which gives its nominal chain; or a chain.
    robot : str or Path, optional
        Robot description, for the format of its logs and its limits. Default: ``robot.toml`` in
        the folder of the model.

    Returns
    -------
    HybridForwardModel
        Fitted; its ``description_`` holds the description of the robot and the notes of the fit.
        A chain is a model with ``error_model="drop"`` that no rows were fitted to: its
        ``training_range_`` is infinite.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not a model, or not one of that robot.

    Examples
    --------
    >>> from hybridkin import open_model, robots
    >>> model = open_model(robots.bionic_handling_assistant())
    >>> x, y, z = model.predict([[0.2] * 9])[0]
    >>> round(float(z), 3)
    0.6
    """
    if isinstance(model, ForwardModel):
        return nominal_hybrid(model)
    path = model_path(model, "model")
    if path.suffix.lower() == ".toml":
        return _described(path)
    return _saved(path, robot)


def _described(path: Path) -> HybridForwardModel:
    """Return the nominal model of a robot description."""
    robot = read_description(path)
    if robot.chain is None:
        raise ValueError(
            f"`model` {path} describes a robot without segments. It has no model before a "
            f"fit: hybridkin fit LOG --robot {path} --out MODEL."
        )
    opened = nominal_hybrid(robot.chain)
    return opened.described(replace(opened.description_, robot=robot, path=path))


def _saved(path: Path, robot: str | Path | None) -> HybridForwardModel:
    """Return the model of a file."""
    if path.suffix.lower() in LOG_SUFFIXES:
        raise ValueError(f"`model` must be a model or a robot description, got the log {path}.")
    if not path.is_file():
        raise FileNotFoundError(
            "`model` must be a saved model, the folder of a fit or a robot description, but there "
            f"is no file {path}."
        )
    opened = load_model(path)
    if not isinstance(opened, HybridForwardModel):
        opened = nominal_hybrid(as_forward_model(opened))
    beside = path.with_name(_ROBOT)
    if robot is None and path.name == MODEL and beside.is_file():
        robot = beside
    description = _of_file(path, opened.description_)
    if robot is not None:
        description = replace(description, robot=read_description(robot))
    n = opened.n_features_in_
    if description.robot.n_actuators not in (0, n):
        raise ValueError(
            f"`robot` {description.name!r} has {description.robot.n_actuators} actuators, but the "
            f"model {path} has {n}; give the description that it was fitted with."
        )
    return opened.described(description)


def _of_file(path: Path, description: ModelDescription) -> ModelDescription:
    """Return what the header of a file says of its model."""
    header = model_header(path)
    return replace(
        description,
        robot=RobotDescription(path.stem, None, (), None),
        path=path,
        training=header.get("training") or {},
        created=header.get("created", ""),
        versions=header.get("versions") or {},
    )
