"""Foundations for all other folders: the interface of models, arrays, entire functions."""
