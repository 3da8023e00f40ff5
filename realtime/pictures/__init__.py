"""Colours and panels that pages and Rerun share."""
