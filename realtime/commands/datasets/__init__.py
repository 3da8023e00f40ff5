"""Verbs that make datasets of other files."""
