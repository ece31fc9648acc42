"""Regressors, independent of any robot: extreme learning machines, and others as torch modules."""
