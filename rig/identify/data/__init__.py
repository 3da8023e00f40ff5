"""Measured data: files, units, checks, and the arrays that the replay runs over."""
