"""Regressors that know no robot: extreme learning machines, and others as torch modules."""
