"""Verbs that turn runs into evidence: correction factors, test programmes."""
