"""Colours and panels that reports and Rerun share."""
