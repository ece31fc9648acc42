"""The compiled program of arcs and rigid offsets: one for all chains of the same structure."""

from __future__ import annotations

import math
from ctypes import CDLL
from functools import lru_cache

import numpy as np

from hybridkin._core.frames import Marker
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.stored import Stored
from hybridkin.native.library import Program, library

_MOST = 64  # programs that are kept


def program_of_arcs(
    n_segments: int, arcs_per_segment: int, markers: tuple[Marker, ...]
) -> Program | None:
    """Return the program from arcs and offsets to K markers in the base frame, if there is one.

    It takes rows (N, 3 A + S): the lengths, x- and y-bendings of A arcs, then the rigid offsets of
    S segments. Its results are points (N, 3 K). None of these numbers is part of the program, so
    that the chains of a calibration share it.
    """
    opened = library()
    if opened is None:
        return None
    return _program(opened, n_segments, arcs_per_segment, markers)


@lru_cache(_MOST)
def _program(
    opened: CDLL, n_segments: int, arcs_per_segment: int, markers: tuple[Marker, ...]
) -> Program | None:
    try:
        return Program(Plan(_stored(n_segments, arcs_per_segment, markers)), opened)
    except NoKernel:
        return None


def _stored(n_segments: int, arcs_per_segment: int, markers: tuple[Marker, ...]) -> Stored:
    """Return the description of a chain in which each offset is a straight arc of its own."""
    n_arcs = n_segments * arcs_per_segment
    arcs = np.arange(n_arcs)
    places = arcs + arcs // arcs_per_segment  # of the arcs; offsets stand after each segment
    ends = np.arange(1, n_segments + 1) * (arcs_per_segment + 1) - 1
    n_all = n_arcs + n_segments
    matrix = np.zeros((3, n_all, 3 * n_arcs + n_segments))
    for kind in range(3):
        matrix[kind, places, kind * n_arcs + arcs] = 1.0
    matrix[0, ends, 3 * n_arcs + np.arange(n_segments)] = 1.0

    moved = []
    for at, *beside in markers:
        at_arc = at * arcs_per_segment
        arc = math.ceil(at_arc) - 1
        place = arc // arcs_per_segment + at_arc
        moved.append([place + (at == math.ceil(at)), *beside])
    arrays = {"base": np.eye(4), "offsets": np.zeros(n_all), "radii": np.ones(n_all)}
    derived = {"arc_matrix": matrix.reshape(3 * n_all, -1), "arc_offset": np.zeros(3 * n_all)}
    return Stored("constant_curvature", {"markers": moved, "stage": None}, arrays, derived=derived)
