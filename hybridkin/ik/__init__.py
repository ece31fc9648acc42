"""Inverse kinematics of any forward model: steps, solutions, tracks, tasks and paths."""
