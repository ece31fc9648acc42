"""A mechanical model plus a learned model of its error."""
