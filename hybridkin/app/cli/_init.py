"""A robot description from answers: the options of `init`, its questions, and the file."""

from __future__ import annotations

import argparse
import itertools
import math
import re
import sys
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hybridkin.app.cli._terminal import write
from hybridkin.app.cli._values import (
    count,
    existing,
    in_millimetres,
    names,
    numbers,
    one_of,
    positive,
    signs,
)
from hybridkin.formats import METRES, UNITS, toml_value, visible

if TYPE_CHECKING:
    from pathlib import Path

    from hybridkin.app.workflow.log import MeasuredLog

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


_KINDS = "tendons, elastic-tendons (they can go slack) or chambers (of measured length or pressure)"
_AT_ZERO = 0.05  # of the range: first values this near to zero are zero
_ALIKE = 0.05  # of the range: first values that differ by less are of one posture
_EACH = "[mm]; one value, or one for each segment"
_LENGTHS = ", ".join(METRES)
_UNIT = f"unit of the actuators: {_LENGTHS}; deg or rad; another name, as counts or bar"
_SIGN = (
    "-1: a pulled tendon counts as positive in the log; 1: as negative; one value, or one for each "
    "actuator"
)
_ANGLE = (
    "angle of the first actuator of a segment [degrees]; one value, one for each segment, or those "
    "of all actuators"
)
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
    _Question("angle", _ANGLE, numbers, (0,)),
    _Question("q_unit", _UNIT, str, "mm"),
    _Question(
        "length",
        f"length of the backbone of a segment, or of its chambers where q is 0 {_EACH}",
        in_millimetres,
    ),
    _Question("spool_radius", f"radius of the spools of motors {_EACH}", in_millimetres, None),
    _Question("counts_per_turn", "q of a whole turn of a spool, in its unit", positive),
    _Question(
        "gain",
        f"change of length for a q of 1, if not from spools {_EACH}",
        in_millimetres,
    ),
    _Question("x_unit", f"unit of the tip: {_LENGTHS}", one_of(*METRES), "mm"),
    _Question("q_sign", _SIGN, signs),
    _Question("q", "columns of the actuators from base to tip, as A,B,...", names),
    _Question("x", "columns of the tip, as X,Y,Z", names),
    _Question("groups", "column that names the motion of a row, or none", str, None),
    _Question("time", "column of the time [s], or none", str, None),
)
_IN_WORDS = {  # by kind; the unit of q is known
    "chambers": {
        "length": "length of a chamber at 0 {unit}",
        "gain": "length that 1 {unit} adds to a chamber",
    },
    "tendons": {"length": "length of the backbone of a segment"},
}
_IN_WORDS["elastic-tendons"] = _IN_WORDS["tendons"]
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
    answers |= {name: given[name] for name in ("header_line", "decimal", "missing")}
    missing = []
    columns = {}
    for question in QUESTIONS:
        name = question.name
        value = given[name]
        needless = _why_needless(name, answers)
        if needless and value is not None:
            raise ValueError(f"{_option(name)} has no use: {needless}; leave it out.")
        if needless or (name == "q_sign" and value is None and _has_chambers(answers)):
            continue
        if name == "x_unit":
            if missing:
                columns = {"q": (), "x": (), "x_unit": "mm"}
            else:
                columns = _proposed(answers, given)
        question = question._replace(default=columns.get(name, question.default))
        if value is None:
            value = _asked(_worded(question, answers)) if ask else question.default
        if value is _NEEDED:
            missing.append(_option(name))
        answers[name] = None if value == "none" else value
    return answers, missing


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _has_chambers(answers: _Answers) -> bool:
    return answers.get("kind") == "chambers"


def _why_needless(name: str, answers: _Answers) -> str:
    """Return why the earlier answers leave no need to answer a question; empty: it is needed."""
    unit = answers.get("q_unit")
    is_length = unit in METRES
    has_spools = answers.get("spool_radius") is not None
    chambers = _has_chambers(answers)
    rules = (
        ("length", "q is the length of the chambers", is_length and chambers),
        ("spool_radius", "q is a length", is_length),
        ("spool_radius", "chambers have no spools", chambers),
        ("counts_per_turn", "it goes with --spool-radius", not has_spools),
        ("counts_per_turn", f"q is an angle, in {unit}", unit in ("deg", "rad")),
        ("gain", "q is a length", is_length),
        ("gain", "the spools give it", has_spools),
    )
    for needless, reason, holds in rules:
        if needless == name and holds:
            return reason
    return ""


def _worded(question: _Question, answers: _Answers) -> _Question:
    """Return a question in the words of the kind of robot and of the unit of q."""
    of_kind = _IN_WORDS.get(answers.get("kind", ""), {})
    if question.name not in of_kind:
        return question
    text = of_kind[question.name].format(unit=answers.get("q_unit"))
    return question._replace(text=f"{text} {_EACH}")


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


def _proposed(answers: _Answers, given: _Answers) -> _Answers:
    """Return the columns whose names look like actuators, tip, motion and time, and their unit."""
    n = answers["segments"] * answers["actuators"]
    if answers["log"] is None:
        return {"q": [f"q{i + 1}" for i in range(n)], "x": ["x", "y", "z"]}
    units = _units_of_columns(answers["log"], given)
    header = [*units]
    proposed: _Answers = {}
    tips = [*filter(_is_tip, zip(header, header[1:], header[2:], strict=False))]
    if tips:
        proposed["x"] = max(tips, key=_likeness_to_tip)
        proposed["x_unit"] = units[proposed["x"][0]] or "mm"
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


def _units_of_columns(log: Path, given: _Answers) -> dict[str, str]:
    """Return the columns of a log with the units in their names."""
    from hybridkin.datasets import log_columns  # loads torch

    return log_columns(
        log,
        given["delimiter"],
        header_line=given["header_line"],
        decimal=given["decimal"] or ".",
    )


def unused_columns(answers: _Answers, given: _Answers) -> list[str]:
    """Return the columns of the log that no answer names."""
    used = {*answers["q"], *answers["x"], answers["groups"], answers["time"]}
    return [name for name in _units_of_columns(answers["log"], given) if name not in used]


def _likeness_to_tip(three: Sequence[str]) -> tuple[bool, bool]:
    """Return whether three columns are called tip, and whether they are no rotations."""
    name = three[0].lower()
    return "tip" in name, "rot " not in name


def _is_tip(three: Sequence[str]) -> bool:
    """Return whether three names differ only in their last x, y and z."""
    axes = zip(three, "xyz", strict=True)
    return len({"#".join(name.lower().rsplit(axis, 1)) for name, axis in axes}) == 1


def with_zeros(answers: _Answers, log: MeasuredLog) -> tuple[_Answers, str]:
    """Return the answers with the zeros of tendons from a log, and words for it.

    They are the median of the first rows of all motions, if these are alike. Readings of encoders
    that are whole turns off do not show them.
    """
    unit = answers["q_unit"]
    is_length = unit in METRES
    whole_turns_off = any(f.kind == "encoder" for f in log.report.findings)
    needless = _has_chambers(answers) or (answers["kind"] != "tendons" and not is_length)
    if needless or whole_turns_off:
        return answers, ""
    span = np.ptp(log.q, axis=0)
    first = np.zeros(1, dtype=int)
    if log.named:
        _, first = np.unique(log.motions, return_index=True)
    starts = log.q[first]
    zeros = np.median(starts, axis=0)
    if (np.abs(zeros) <= _AT_ZERO * span).all():
        return answers, ""
    if (np.median(np.abs(starts - zeros), axis=0) > _ALIKE * span).any():
        words = (
            "The actuators do not start at 0, and the motions do not start alike: give `zeros` of "
            "every [[segment]], their values at the straight robot."
        )
        return answers, words
    words = (
        "The actuators do not start at 0: `zeros` are the median of the first rows of the motions "
        f"({len(first)}). Check that the robot is straight there."
    )
    if not is_length:
        zeros = zeros / UNITS.get(unit, 1.0)  # in the unit of the log
    return {**answers, "zeros": [float(f"{zero:.6g}") for zero in zeros]}, words


def description(answers: _Answers, name: str) -> str:
    """Return the robot description of the answers, every key with a comment."""
    template = (files("hybridkin.app.cli") / "robot.toml").read_text(encoding="utf-8")
    head, segment, tail = re.split(r"(?=\[\[segment|# The logs)", template)
    segments = []
    for values, alike in itertools.groupby(_segments(answers)):
        segments.append(_filled(segment, {**values, "repeat": len([*alike])}))
    values = {**answers, **_MODELS[answers["kind"]], "name": name}
    return "".join([_filled(head, values), *segments, _filled(tail, values)])


def _segments(answers: _Answers) -> list[_Answers]:
    """Return what the template says of every segment."""
    n = answers["segments"]
    n_actuators = answers["actuators"]
    angles = answers["angle"]
    all_angles = len(angles) == n * n_actuators != n
    columns = {
        "radius": _each(answers, "radius"),
        "length": _each(answers, "length"),
        "gain": _each(answers, "gain"),
        "spool_radius": _each(answers, "spool_radius"),
    }
    if not all_angles:
        columns["angle"] = _each(answers, "angle")
    per_turn = answers.get("counts_per_turn")
    segments = []
    for k in range(n):
        values: _Answers = {key: column[k] for key, column in columns.items()}
        values |= {"actuators": n_actuators, "clockwise": False, "angles": None}
        values["zeros"] = None
        of_segment = slice(k * n_actuators, (k + 1) * n_actuators)
        if "zeros" in answers:
            values["zeros"] = answers["zeros"][of_segment]
        if all_angles:
            values |= dict.fromkeys(("actuators", "clockwise", "angle"))
            values["angles"] = angles[of_segment]
        if per_turn is not None:
            gain = math.tau * values["spool_radius"] / per_turn
            values["gain"] = float(f"{gain:.9g}")
            values["spool_radius"] = None
        if _has_chambers(answers) and values["length"] is not None:
            values["zeros"] = float(f"{-values['length'] / values['gain']:.9g}")
            values["length"] = None
        segments.append(values)
    return segments


def _each(answers: _Answers, key: str) -> Sequence[float | None]:
    """Return the value of every segment; None where there is no answer."""
    values = answers.get(key) or (None,)
    n = answers["segments"]
    if len(values) not in (1, n):
        of_all = ", or those of all actuators" if key == "angle" else ""
        raise ValueError(
            f"{_option(key)} must be one value, or one for each segment{of_all}, got {len(values)}."
        )
    return [*values] * (n // len(values))


def _filled(block: str, values: _Answers) -> str:
    """Return a part of the template with its values; keys without one become comments."""
    block = re.sub(r"\$(\w+)", lambda name: toml_value(values[name[1]]), block)
    return re.sub(r"^(\w+ =) null$", r"# \1", block, flags=re.MULTILINE)
