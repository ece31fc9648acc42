"""Blocks of header lines: what motion-capture programs write above the numbers of a text file."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from hybridkin._core.text_rows import Row, is_number
from hybridkin._core.units import METRES, UNITS

TIME = "Time (Seconds)"
"""Name of the times that follow from the rate of a file."""

_LENGTHS = {  # as Motive writes them
    "meters": "m",
    "centimeters": "cm",
    "millimeters": "mm",
    "micrometers": "um",
    "inches": "in",
}
_AXES = ("X", "Y", "Z", "W")
_SIGNS_OF_UNITS = {*UNITS, "s", "ms", "us", "ns", "bar", "kPa", "Pa", "N"} - {"1"}
_AXIS = re.compile("([RT]?)([XYZW]'*)")  # of Vicon; X' is a speed
_OF_BODY = re.compile(r"[XYZ]|Roll|Pitch|Yaw|Residual|Rot\[\d\]")  # of Qualisys
_OF_BODIES = {"R": "rot "}


@dataclass(frozen=True)
class Header:
    """Names of columns, and what else stands above the numbers.

    Attributes
    ----------
    line : int
        Line of the names, from 1.
    names : list of str
        Names of the columns.
    rows : slice
        Place of the rows of numbers among all rows.
    units : mapping of str to str
        Unit of length of some columns, as the file states it.
    statement : str
        Where it states them.
    rate : float
        Frames per second, from which the times follow; 0: the rows hold times, or none are known.
    """

    line: int
    names: list[str]
    rows: slice
    units: Mapping[str, str] = field(default_factory=dict)
    statement: str = ""
    rate: float = 0.0


class HeaderBlock(ABC):
    """A kind of header lines."""

    @abstractmethod
    def recognises(self, rows: Sequence[Row]) -> bool:
        """Return whether the rows begin with such lines."""

    @abstractmethod
    def header(self, rows: Sequence[Row]) -> Header:
        """Return what they say."""


class Plain(HeaderBlock):
    """Names of columns in the first row, perhaps behind "#", and units in the second."""

    def recognises(self, rows: Sequence[Row]) -> bool:
        """Return True."""
        return True

    def header(self, rows: Sequence[Row]) -> Header:
        """Return the names."""
        first, *others = [cell.strip() for cell in rows[0].cells]
        names = [first.lstrip("# "), *others]
        if not first.strip("# ") and len(others) == len(_filled_cells(rows[-1])):
            names = others  # a "#" that spaces set apart
        if not _holds_units(rows[1:2]):
            return Header(rows[0].line, names, slice(1, None))
        units = {}
        for name, cell in zip(names, rows[1].cells, strict=False):
            unit = _bare(cell)
            if unit in UNITS and unit != "1":
                units[name] = unit
        return Header(
            rows[0].line,
            names,
            slice(2, None),
            units,
            f"line {rows[1].line} holds the units",
        )


class Motive(HeaderBlock):
    """A CSV export of OptiTrack Motive.

    Its first line says "Format Version"; rows of types, names, IDs and properties stand above
    the row "Frame, Time (Seconds), X, Y, Z ...".
    """

    def recognises(self, rows: Sequence[Row]) -> bool:
        """Return whether the first cell says so, and there is a row of frames."""
        return _first_cell(rows[0]) == "format version" and _place(rows, "frame") > 2

    def header(self, rows: Sequence[Row]) -> Header:
        """Return the names: "marker X", or "body X" and "body rot X" of rigid bodies."""
        place = _place(rows, "frame")
        labelled = {_cell(row, 1).lower(): row for row in rows[1:place]}
        objects = labelled.get("name", rows[2])
        kinds = labelled.get("type", rows[1])
        properties = rows[place - 1]
        names = []
        plain = []
        for k, cell in enumerate(rows[place].cells):
            axis = cell.strip()
            what = _cell(properties, k)
            if what.lower() == "rotation":
                axis = f"rot {axis}"
            elif what.lower() != "position" and k > 1:
                axis = f"{what} {axis}".strip()
            names.append(f"{_cell(objects, k)} {axis}".strip() if k > 1 else axis)
            plain.append(what.lower() == "position")
        names = _distinct(names, kinds)
        stated = _settings(rows[0].cells).get("length units", "").lower()
        unit = _LENGTHS.get(stated, "")
        positions = [name for name, is_place in zip(names, plain, strict=True) if is_place]
        return Header(
            rows[place].line,
            names,
            slice(place + 1, None),
            dict.fromkeys(positions, unit) if unit else {},
            f"line {rows[0].line} says Length Units {stated}",
        )


class Vicon(HeaderBlock):
    """A CSV export of Vicon Nexus.

    A section has a title, the rate, the names of markers or bodies, the row "Frame, Sub Frame,
    X, Y, Z ..." and a row of units. Of several sections the trajectories are read, else the last.
    """

    def recognises(self, rows: Sequence[Row]) -> bool:
        """Return whether the fourth row, below a rate, is that of frames."""
        return bool(_sections(rows[:8]))

    def header(self, rows: Sequence[Row]) -> Header:
        """Return the names: "marker X", or "body X" and "body rot X" of bodies."""
        sections = _sections(rows)
        titles = [_first_cell(rows[place - 3]) for place in sections]
        place = sections[-1]
        if "trajectories" in titles:
            place = sections[titles.index("trajectories")]
        axes = rows[place]
        names = []
        units = {}
        marker = ""
        for k, cell in enumerate(axes.cells):
            marker = _cell(rows[place - 1], k).rpartition(") ")[2] or marker
            unit = _cell(rows[place + 1], k)
            axis = cell.strip()
            is_axis = _AXIS.fullmatch(axis)
            if is_axis:
                axis = _OF_BODIES.get(is_axis[1], "") + is_axis[2]
            names.append(f"{marker} {axis}" if k > 1 and (is_axis or unit) else axis)
            if unit in METRES:
                units[names[-1]] = unit
        first = place + 1 + (not _starts_with_number(rows[place + 1]))
        last = first
        while last < len(rows) and _starts_with_number(rows[last]):
            last += 1
        return Header(
            axes.line,
            names,
            slice(first, last),
            units,
            f"line {rows[place + 1].line} holds the units",
            _rate(_cell(rows[place - 2], 0)),
        )


class Qualisys(HeaderBlock):
    """A TSV export of Qualisys Track Manager: "NO_OF_FRAMES" and other settings, a row each.

    Markers (3D) or bodies (6D) are named in the row "MARKER_NAMES" or "BODY_NAMES"; a row of names
    of the columns may follow. Positions are in millimetres.
    """

    def recognises(self, rows: Sequence[Row]) -> bool:
        """Return whether rows of settings name markers or bodies."""
        settings = self._settings_of(rows)
        return "no_of_frames" in settings and self._key(settings) != ""

    def header(self, rows: Sequence[Row]) -> Header:
        """Return the names: "marker X", or of bodies "body X", "body Roll", "body Rot[0]" ..."""
        settings = self._settings_of(rows)
        first = 0
        while not _starts_with_number(rows[first]):
            first += 1
        objects = [cell.strip() for cell in settings[self._key(settings)].cells[1:]]
        objects = [name for name in objects if name]
        above = rows[first - 1]
        if _first_cell(above) in ("frame", "time") or _cell(above, 0).endswith(" X"):
            names = self._named(above, objects, len(rows[first].cells))
        else:
            above = settings[self._key(settings)]
            n_before = len(_filled_cells(rows[first])) - 3 * len(objects)
            names = ["Frame", "Time"][: max(n_before, 0)]
            names += [f"{name} {axis}" for name in objects for axis in _AXES[:3]]
        positions = [name for name in names if name[-2:] in (" X", " Y", " Z")]
        rate = _rate(_cell(settings.get("frequency", rows[0]), 1))
        return Header(
            above.line,
            names,
            slice(first, None),
            dict.fromkeys(positions, "mm"),
            "Qualisys writes millimetres",
            0.0 if "Time" in names else rate,
        )

    def _settings_of(self, rows: Sequence[Row]) -> dict[str, Row]:
        settings = {}
        for row in rows[:60]:
            if _starts_with_number(row):
                break
            settings[_first_cell(row)] = row
        return settings

    def _key(self, settings: Mapping[str, Row]) -> str:
        for key in ("marker_names", "body_names"):
            if key in settings:
                return key
        return ""

    def _named(self, row: Row, objects: Sequence[str], n_cells: int) -> list[str]:
        """Return the names of a row in which "body X" stands before "Y", "Z", "Roll" ..."""
        names = [cell.strip() for cell in row.cells]
        bodies = [name for name in names if name in objects]
        alone = bool(bodies) and len(names) > n_cells  # no column of its own
        body = ""
        full = []
        for name in names:
            if name in objects:
                body = name
                if alone:
                    continue
            elif name.endswith(" X") and name[:-2] in objects:
                body = name[:-2]
            elif body and _OF_BODY.fullmatch(name):
                name = f"{body} {name}".strip()
            full.append(name)
        return full


KINDS: tuple[HeaderBlock, ...] = (Motive(), Vicon(), Qualisys(), Plain())


def _holds_units(rows: Sequence[Row]) -> bool:
    """Return whether a row below names has no number, but the sign of a unit."""
    for row in rows:
        cells = [_bare(cell) for cell in row.cells]
        no_numbers = not any(cell and is_number(cell) for cell in cells)
        return no_numbers and any(cell in _SIGNS_OF_UNITS for cell in cells)
    return False


def _bare(cell: str) -> str:
    """Return the text of a cell without spaces and brackets."""
    return cell.strip().strip("[]()").strip()


def _first_cell(row: Row) -> str:
    return _cell(row, 0).lower()


def _cell(row: Row, k: int) -> str:
    return row.cells[k].strip() if k < len(row.cells) else ""


def _filled_cells(row: Row) -> list[str]:
    """Return the cells up to the last that is not empty."""
    cells = list(row.cells)
    while cells and not cells[-1].strip():
        cells.pop()
    return cells


def _starts_with_number(row: Row) -> bool:
    return _cell(row, 0) != "" and is_number(row.cells[0])


def _place(rows: Sequence[Row], first_cell: str) -> int:
    """Return the place of the first row that begins with a word, else -1."""
    for place, row in enumerate(rows[:20]):
        if _first_cell(row) == first_cell:
            return place
    return -1


def _sections(rows: Sequence[Row]) -> list[int]:
    """Return the places of the rows "Frame, Sub Frame ..." that stand below a title and a rate."""
    places = []
    for place in range(3, len(rows) - 1):
        cells = rows[place].cells
        if _first_cell(rows[place]) != "frame" or _cell(rows[place], 1) != "Sub Frame":
            continue
        if len(cells) > 2 and _rate(_cell(rows[place - 2], 0)) > 0.0:
            places.append(place)
    return places


def _settings(cells: Sequence[str]) -> dict[str, str]:
    """Return the pairs of a row "key, value, key, value ...", keys in lower case."""
    stripped = [cell.strip() for cell in cells]
    return dict(zip(map(str.lower, stripped[::2]), stripped[1::2], strict=False))


def _rate(text: str) -> float:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return 0.0


def _distinct(names: Sequence[str], kinds: Row) -> list[str]:
    """Return names in which the kind of object stands before those that occur twice."""
    counts = Counter(names)
    return [
        f"{_cell(kinds, k)} {name}" if counts[name] > 1 and name else name
        for k, name in enumerate(names)
    ]
