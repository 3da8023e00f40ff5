"""What can differ or fail in each place of a train: places, failures, and what they do to a run."""
