"""Checks the data before any statistics: scales, channels, order of axles, sampling."""
