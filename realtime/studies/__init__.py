"""Runs as measured data, and the paper's six stops on the bench."""
