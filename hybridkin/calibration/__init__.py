"""Calibration of a robot's geometry and backlash from measured tips."""
