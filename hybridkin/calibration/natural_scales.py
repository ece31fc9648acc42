"""Natural scales of what is unknown of a robot: standard deviations of priors, with their reasons.

Lengths are relative to the robot (its reach, a segment's length), angles are in radians.
"""

GEOMETRY = 0.5
"""Of the geometry that `calibrate` is asked for: its start may be a rough guess."""

STRUCTURE = {
    # A calibrated or measured base: what a hand-held square and a ruler leave.
    "base turn": 0.1,  # [rad]
    "base move": 0.0375,  # of the reach; 3 cm of a robot of 0.8 m
    # Zeros of length gauges, and bends of a straight robot at rest.
    "zero lengths": 0.02,  # of the length of a segment
    "zero bends": 0.03,  # [rad]
    # Radius and angle of a ring of actuators.
    "ring stretch": 0.08,
    "ring turn": 0.03,  # [rad]
    # Other linear errors of one segment: unequal radii, actuators that share their stretch.
    "ring maps": 0.005,
    # Twist of a segment [rad] if a load, at its largest lever, acts across it; common to all
    # segments, as they carry the same load, and the part of each one.
    "gravity": 0.5,
    "twists": 0.1,
    # Sideways bend [rad] by the same load, per twist, and the part of each segment. For a rod
    # clamped at both ends the ratio is GJ / (12 S EI), 0.02 to 0.06 for three segments; actuators
    # make real segments softer sideways. From 0.03 to 0.1 the errors differ by less than 6 %.
    "sag of a twist": 0.1,
    "sags": 0.01,
}
"""Of the errors that remain in a calibrated structure."""
