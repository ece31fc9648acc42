"""Sentences about a calibrated geometry that is far from the description of the robot."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.workflow.report import geometry_entries

_SIZES = ("radii", "lengths", "gain", "gains")
_FAR = 0.15  # of a size; more than the error of a ruler
_TURN, _TILT = 30.0, 45.0  # [deg]


def deviations(start: Chain, result: CalibrationResult) -> Iterator[str]:
    """Yield what the calibration moved far from the description, and what else may be wrong."""
    far = []
    for entry in geometry_entries(start, result):
        name, before, value = (entry[key] for key in ("name", "start", "value"))
        is_size = name.partition("[")[0] in _SIZES and entry["physical"]
        if is_size and abs(value / before - 1.0) > _FAR:
            far.append(f"{name} from {before:.4g} to {value:.4g} {entry['unit']}")
    if far:
        yield (
            f"the calibration moved {', '.join(far)}: if a ruler contradicts, `gain`, "
            "`spool_radius` or `routing` may be wrong, the marker is not at the tip, or tendons "
            "are slack."
        )
    if not isinstance(start, ArcChain) or not isinstance(result.chain, ArcChain):
        return
    if {"turns", "angles"} & {*result.values}:
        change = (result.chain.angles - start.angles).detach().cpu().numpy()
        turned = (change - change[0] + np.pi) % (2.0 * np.pi) - np.pi
        if (most := np.degrees(np.abs(turned).max())) > _TURN:
            yield (
                f"the calibration turned actuators by up to {most:.0f} degrees about the backbone "
                "relative to the first: if they are not attached so, `angle_deg`, `clockwise`, or "
                "the order or signs of the columns of q may be wrong."
            )
    cosine = float(start.base[:3, 2] @ result.chain.base[:3, 2])
    tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if tilt > _TILT and not start.absolute.all():
        yield (
            f"the calibrated base is tilted by {tilt:.0f} degrees from the description: a wrong "
            "sign of all tendons, which turns the base by 180 degrees about its axis, is then not "
            "noticed. Check `q_sign` by pulling a tendon, or describe the mounting in [base]."
        )
