"""A robot description from answers: the options of `init`, its questions, and the file."""

from __future__ import annotations

import argparse
import itertools
import math
import re
import sys
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

import hybridkin
from hybridkin._core.texts import toml_value, visible
from hybridkin._core.units import METRES
from hybridkin.cli._terminal import write
from hybridkin.cli._values import (
    count,
    existing,
    in_millimetres,
    names,
    numbers,
    one_of,
    positive,
)

_NEEDED = object()  # the default of what must be given
_Answers = dict[str, Any]
_MODELS = {
    "tendons": {"model": "constant-curvature", "routing": "base"},
    "elastic-tendons": {"model": "elastic-tendon", "routing": "base"},
    "chambers": {"model": "constant-curvature", "routing": "segment"},
}


class _Question(NamedTuple):
    name: str
    text: str
    parse: Callable[[str], Any]
    default: Any = _NEEDED


_KINDS = "tendons, elastic-tendons (they can go slack) or chambers (of measured length)"
_SIZES = ("radius", "length", "angle", "gain", "spool_radius", "zeros")
_AT_ZERO = 0.05  # of the range: first values this near to zero are zero
_ALIKE = (
    0.05  # of the range: first values of motions that differ by less are one posture
)
_EACH = "[mm]; one value, or one for each segment"
_LENGTHS = ", ".join(METRES)
_UNIT = f"unit of the actuators: {_LENGTHS}; deg or rad of motors; another name, such as counts"
_SIGN = "-1: a pulled tendon counts as positive in the log; 1: as negative"
QUESTIONS = (
    _Question("log", "log file: CSV, npz or parquet", existing, None),
    _Question("kind", _KINDS, one_of(*_MODELS)),
    _Question("segments", "number of segments", count),
    _Question("actuators", "number of actuators in each segment", count, 3),
    _Question(
        "radius",
        f"radius of the circle on which the actuators lie {_EACH}",
        in_millimetres,
    ),
    _Question("length", f"length of the backbone of a segment {_EACH}", in_millimetres),
    _Question(
        "angle", "angle of the first actuator of a segment [degrees]", numbers, (0,)
    ),
    _Question("q_unit", _UNIT, str, "mm"),
    _Question(
        "spool_radius", f"radius of the spools of motors {_EACH}", in_millimetres, None
    ),
    _Question("counts_per_turn", "q of a whole turn of a spool, in its unit", positive),
    _Question(
        "gain", "change of length for a q of 1, if not from spools [mm]", in_millimetres
    ),
    _Question("x_unit", f"unit of the tip: {_LENGTHS}", one_of(*METRES), "mm"),
    _Question("q_sign", _SIGN, one_of(1, -1)),
    _Question("q", "columns of the actuators from base to tip, as A,B,...", names),
    _Question("x", "columns of the tip, as X,Y,Z", names),
    _Question("groups", "column that names the motion of a row, or none", str, None),
    _Question("time", "column of the time [s], or none", str, None),
)
_WORDS = {  # how names of columns begin
    "groups": "motion|pattern|group|run|trial|episode|traj|trajectory|sequence",
    "time": "t|time|times|timestamp|stamp|seconds",
}


def answered(given: _Answers, ask: bool) -> tuple[_Answers, list[str]]:
    """Return the answers to all questions, and the options that are missing.

    An answer is that of an option, else that of the user if `ask` is set, else the default. The
    defaults of columns come from the header of the log.
    """
    answers: _Answers = {"q_sign": 1}
    missing = []
    columns = {}
    for question in QUESTIONS:
        name = question.name
        if _is_needless(name, answers, given):
            continue
        if name == "q":
            if missing:
                columns = {"q": (), "x": ()}
            else:
                columns = _proposed(answers, given["delimiter"])
        question = question._replace(default=columns.get(name, question.default))
        value = given[name]
        if value is None:
            value = _asked(question) if ask else question.default
        if value is _NEEDED:
            missing.append(f"--{name.replace('_', '-')}")
        answers[name] = None if value == "none" else value
    return answers, missing


def _is_needless(name: str, answers: _Answers, given: _Answers) -> bool:
    """Return whether the earlier answers leave no need to answer a question."""
    if name in ("length", "q_sign"):
        return answers["kind"] == "chambers"
    unit = answers.get("q_unit")
    spools = answers.get("spool_radius")
    if name == "counts_per_turn":
        return spools is None or unit in ("deg", "rad")
    if name not in ("spool_radius", "gain") or given[name] is not None:
        return False
    return unit in METRES or (name == "gain" and spools is not None)


def _asked(question: _Question) -> Any:
    """Return what the user answers to a question on standard error; empty: the default."""
    name, text, parse, default = question
    if isinstance(default, tuple | list):
        proposal = ",".join(map(str, default))
    else:
        proposal = default
    hint = "" if default is _NEEDED else f" [{proposal or 'none'}]"
    while True:
        write(f"{name}: {text}{visible(hint)}: ", sys.stderr, end="")
        answer = input().strip()
        if not answer and default is not _NEEDED:
            return default
        try:
            return parse(answer)
        except (ValueError, argparse.ArgumentTypeError) as error:
            clear = isinstance(error, argparse.ArgumentTypeError)
            write(f"  {error if clear else 'must be a number'}", sys.stderr)


def _proposed(answers: _Answers, delimiter: str | None) -> _Answers:
    """Return the columns whose names look like actuators, tip, motion and time."""
    n = answers["segments"] * answers["actuators"]
    if answers["log"] is None:
        return {"q": [f"q{i + 1}" for i in range(n)], "x": ["x", "y", "z"]}
    header = hybridkin.datasets.log_columns(answers["log"], delimiter)
    proposed: _Answers = {}
    tips = [*filter(_is_tip, zip(header, header[1:], header[2:], strict=False))]
    if tips:
        proposed["x"] = max(tips, key=lambda three: "tip" in three[0].lower())
    families: dict[str, list[str]] = {}  # names that differ in numbers only
    for name in header:
        if name not in proposed.get("x", ()) and re.search(r"\d", name):
            families.setdefault(re.sub(r"\d+", "", name), []).append(name)
    for family in (*families.values(), [*itertools.chain(*families.values())]):
        if len(family) == n:
            proposed.setdefault("q", family)
    for key, words in _WORDS.items():
        for name in header:
            if re.match(rf"({words})(?![a-z\d])", name.lower()):
                proposed.setdefault(key, name)
    return proposed


def _is_tip(three: Sequence[str]) -> bool:
    """Return whether three names differ only in their last x, y and z."""
    axes = zip(three, "xyz", strict=True)
    return len({"#".join(name.lower().rsplit(axis, 1)) for name, axis in axes}) == 1


def with_zeros(answers: _Answers, delimiter: str | None) -> tuple[_Answers, str]:
    """Return the answers with the zeros of tendons from the first rows of a log, and words for it.

    They are the median of the first rows of all motions, if these are alike.
    """
    if answers["log"] is None or answers["kind"] == "chambers":
        return answers, ""
    log = hybridkin.datasets.load_log(
        answers["log"],
        answers["q"],
        answers["x"],
        answers["groups"],
        q_unit="1",
        x_unit=answers["x_unit"],
        q_sign=answers["q_sign"],
        delimiter=delimiter,
        drop_invalid=True,
    )
    span = np.ptp(log.q, axis=0)
    first = np.zeros(1, dtype=int)
    if log.groups is not None:
        _, first = np.unique(log.groups, return_index=True)
    starts = log.q[first]
    zeros = np.median(starts, axis=0)
    if (np.abs(zeros) <= _AT_ZERO * span).all():
        return answers, ""
    if (np.median(np.abs(starts - zeros), axis=0) > _ALIKE * span).any():
        words = (
            "The actuators do not start at 0, and the motions do not start alike: set `zeros` in "
            "every [[segment]] to their values at the straight robot."
        )
        return answers, words
    if answers["q_unit"] in METRES:
        zeros = METRES[answers["q_unit"]] * zeros  # lengths are in metres there
    rounded = [float(f"{zero:.6g}") for zero in zeros]
    n = answers["actuators"]
    segments = [rounded[k : k + n] for k in range(0, len(rounded), n)]
    words = (
        f"The actuators do not start at 0: `zeros` are the values of the first row of "
        f"{len(first)} motion{'s' if len(first) > 1 else ''}. Check that the robot is straight "
        "there."
    )
    return {**answers, "zeros": segments}, words


def description(answers: _Answers, name: str) -> str:
    """Return the robot description of the answers, every key with a comment."""
    template = (files("hybridkin.cli") / "robot.toml").read_text(encoding="utf-8")
    head, segment, tail = re.split(r"(?=\[\[segment|# The logs)", template)
    if per_turn := answers.get("counts_per_turn"):
        gains = [
            float(f"{math.tau * r / per_turn:.9g}") for r in answers["spool_radius"]
        ]
        answers = {**answers, "gain": gains, "spool_radius": None}
    sizes = [_of_segments(answers, key) for key in _SIZES]
    segments = [
        _filled(segment, {**answers, "repeat": len([*alike]), **dict(values)})
        for values, alike in itertools.groupby(zip(*sizes, strict=True))
    ]
    values = {**answers, **_MODELS[answers["kind"]], "name": name}
    return "".join([_filled(head, values), *segments, _filled(tail, values)])


def _of_segments(answers: _Answers, key: str) -> Sequence[tuple[str, float | None]]:
    """Return a key and its value for every segment."""
    values = answers.get(key) or (None,)
    n = answers["segments"]
    if len(values) not in (1, n):
        option = f"--{key.replace('_', '-')}"
        raise ValueError(
            f"{option} must be one value, or one for each segment, got {len(values)}."
        )
    return [(key, value) for value in values] * (n // len(values))


def _filled(block: str, values: _Answers) -> str:
    """Return a part of the template with its values; keys without one become comments."""
    block = re.sub(r"\$(\w+)", lambda name: toml_value(values[name[1]]), block)
    return re.sub(r"^(\w+ =) null$", r"# \1", block, flags=re.MULTILINE)
