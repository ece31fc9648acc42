"""Regressors without knowledge of robots: extreme learning machines, others as torch modules."""
