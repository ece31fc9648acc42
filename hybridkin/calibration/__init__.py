"""Geometry and backlash of a robot from measured tips."""
