"""Identification: what measured data shows about the model, and an extended model that fits better.

`statistics` has what all kinds of data share: robust lines, resampling, and the interval that
decides what is a finding.

Reading order: `data` (datasets, checks, smooth inputs), `replay` (the filters and their linear
response), `causes` (the table of causes, and their columns), `decide` (fits, null simulations, the
score tests, and `decision`, which runs all of them in order), `next_stops` (proposals of further
stops). `paper` tunes and validates the model as the paper does, and fits measured creep curves.
`train_recorder` examines recordings without load and torque; it does not use the replay.
"""
