"""Hysteresis of the actuators: a value of stages in series, and its fit to a log."""
