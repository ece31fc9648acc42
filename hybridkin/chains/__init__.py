"""Mechanical models: constant curvature, elastic tendons, rigid arms, robots, backlash."""
