"""Measured and simulated data: pairs of actuator vectors and tip positions, in SI units."""

from hybridkin.datasets._protocol import paper_protocol, paper_split
from hybridkin.datasets._recordings import load_armlab, load_asl_trunk, load_csv, load_ftdcr
from hybridkin.datasets._trunk import load_trunk, make_trunk

__all__ = [
    "load_armlab",
    "load_asl_trunk",
    "load_csv",
    "load_ftdcr",
    "load_trunk",
    "make_trunk",
    "paper_protocol",
    "paper_split",
]
