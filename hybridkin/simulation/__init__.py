"""Simulated robots instead of real ones: a plant to track with, and a source of data."""

from hybridkin.simulation.trunk import NotSettledError, TrunkPlant

__all__ = ["NotSettledError", "TrunkPlant"]
