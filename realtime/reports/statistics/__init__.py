"""The parts of reports about statistics of many runs."""
