"""What is known of a model: geometry, training, domain, errors, and what was chosen."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hybridkin.workflow._fit_report import auto_entry, auto_in_short, auto_in_words
from hybridkin.workflow.model import OpenedModel


def describe_model(opened: OpenedModel) -> dict[str, Any]:
    """Return what is known of a model, in SI units and degrees.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.

    Returns
    -------
    dict
        "kind", "n_actuators", "geometry" of the chain, "error_model", "training", "domain",
        "radius", "play" (width [m]), "auto", "log_format", "limits", "created" and "versions" of
        what wrote the file; None where there is nothing to tell.
    """
    found: dict[str, Any] = {
        "name": opened.name,
        "path": str(opened.path),
        "kind": type(opened.model).__name__,
        "n_actuators": opened.n_actuators,
        "geometry": None if opened.chain is None else geometry(opened.chain),
        "error_model": None,
        "play": None if opened.play is None else np.ravel(opened.play.width).tolist(),
        "auto": None,
        "training": None,
        "created": None,
        "versions": None,
        "domain": None,
        "radius": None,
        "log_format": None,
        "limits": None,
    }
    if opened.is_hybrid:
        model = opened.model
        found["error_model"] = {
            "kind": _kind(model.error_model_),
            "coupling": model.coupling,
            "guard": model.guard,
            "calibrated": list(model.calibrate)
            if not isinstance(model.calibrate, str)
            else [model.calibrate],
        }
        if model.radius_ is not None:
            found["radius"] = model.radius_._asdict()
        if model.cv_results_ is not None:
            entry = auto_entry(model)
            found["error_model"] |= {"kind": auto_in_short(entry), "coupling": None}
            found["auto"] = {**entry, "words": auto_in_words(entry)}
    if opened.header is not None:
        found |= {key: opened.header.get(key) for key in ("training", "created", "versions")}
    if opened.trained_range is not None:
        low, high = opened.trained_range
        found["domain"] = {"q_min": low.tolist(), "q_max": high.tolist()}
    if opened.description is not None:
        log, limits = opened.description.log, opened.description.limits
        found["log_format"] = None if log is None else dict(vars(log))
        found["limits"] = {
            name: None if value is None else value.tolist() for name, value in vars(limits).items()
        }
    return found


def geometry(chain: Any) -> dict[str, Any]:
    """Return the geometry of a chain.

    Returns
    -------
    dict
        "kind"; of chains of arcs "routing" and "segments", each with radius, length and offset [m],
        angles and rest bend [deg] and, behind elastic tendons, stiffnesses; "base" position [m] and
        rotation vector [deg].
    """
    found: dict[str, Any] = {"kind": type(chain).__name__, "base": _base(chain)}
    if getattr(chain, "radii", None) is None:
        return found
    lengths = None if chain.lengths is None else chain.lengths.tolist()
    ends = np.cumsum(chain.actuators_per_segment)[:-1]
    angles = np.split(np.degrees(_numbers(chain.angles)), ends)
    bends = getattr(chain, "rest_bends", None)
    segments = []
    for k, radius in enumerate(chain.radii.tolist()):
        entry: dict[str, Any] = {"radius": radius}
        entry["length"] = None if lengths is None else lengths[k]
        entry["offset"] = float(_numbers(chain.offsets)[k])
        entry["angles_deg"] = angles[k].tolist()
        if bends is not None:
            entry["rest_bend_deg"] = np.degrees(_numbers(bends).reshape(-1, 2)[k]).tolist()
        for name in ("bending_stiffness", "axial_stiffness"):
            if getattr(chain, name, None) is not None:
                entry[name] = float(_numbers(getattr(chain, name)).ravel()[k])
        segments.append(entry)
    return {**found, "routing": chain.routing, "segments": segments}


def _base(chain: Any) -> dict[str, Any] | None:
    base = getattr(chain, "base", None)
    if base is None:
        return None
    pose = _numbers(base)
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec(degrees=True)
    return {"position": pose[:3, 3].tolist(), "rotation_vector_deg": turn.tolist()}


def _kind(error_model: Any) -> str:
    """Return the name of an error model, of a blend that of its parts with their weights."""
    if error_model is None:
        return "none"
    if not hasattr(error_model, "error_models"):
        return type(error_model).__name__
    parts = zip(error_model.weights, error_model.error_models, strict=True)
    return "blend of " + ", ".join(f"{w:.1f} {_kind(one)}" for w, one in parts)


def _numbers(value: torch.Tensor) -> np.ndarray:
    return value.detach().cpu().double().numpy()
