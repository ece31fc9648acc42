"""What the README of exported code says of its numbers and names."""

from __future__ import annotations

import re
import textwrap

import numpy as np
from numpy.typing import NDArray

_KINDS_OF_LIMITS = ("q", "its speed", "its acceleration")
_NO_LIMITS = """\
It keeps no limits of q, of its speed or
acceleration: limit its commands before the robot gets them.
"""


def limits_in_words(limits: NDArray) -> str:
    """Return sentences about limits (4, n) of q, below and above, of its speed and acceleration."""
    low, high, speed, acceleration = limits
    kept = []
    has_low = np.isfinite(low).any()
    has_high = np.isfinite(high).any()
    if has_low and has_high:
        kept.append(f"q between {_listed(low)} and {_listed(high)}")
    elif has_low:
        kept.append(f"q above {_listed(low)}")
    elif has_high:
        kept.append(f"q below {_listed(high)}")
    if np.isfinite(speed).any():
        kept.append(f"its speed below {_listed(speed)} per second")
    if np.isfinite(acceleration).any():
        kept.append(f"the change of that speed below {_listed(acceleration)} per second")
    if not kept:
        return _NO_LIMITS
    words = " and ".join(kept)
    if len(kept) > 2:
        words = f"{', '.join(kept[:-1])}, and {kept[-1]}"
    text = f"It keeps {words}."
    if len(kept) < len(_KINDS_OF_LIMITS):
        absent = []
        for kind, values in zip(_KINDS_OF_LIMITS, (limits[:2], speed, acceleration), strict=True):
            if not np.isfinite(values).any():
                absent.append(kind)
        text += f" It has no limit of {' and of '.join(absent)}."
    if np.isfinite(speed).any():
        text += " From outside the limits q returns at that speed."
    return textwrap.fill(text, 98, break_on_hyphens=False) + "\n"


def _listed(values: NDArray) -> str:
    """Return numbers for a reader, in three digits; one if they are all alike."""
    texts = [f"{float(f'{value:.3g}'):g}" for value in values.tolist()]
    if len({*texts}) == 1:
        return texts[0]
    return f"({', '.join(texts)})"


def class_in_words(name: str) -> str:
    """Return the name of a class in words: "Inverse kinematics" for InverseKinematics."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name).split()
    first, *others = words
    words = [first, *(word if word.isupper() else word.lower() for word in others)]
    return " ".join(words).replace("module", "model")
