"""Simulated robots in the place of real ones: a plant to track with, a source of data."""

from hybridkin.simulation.trunk import NotSettledError, TrunkPlant

__all__ = ["NotSettledError", "TrunkPlant"]
