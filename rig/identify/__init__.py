"""Finds what measured data say about the model: what is wrong, why, and a better model.

Reading order: `data` (datasets, checked and prepared), `replay` (the filters), `causes` (mechanisms
as changes of a replay), `decide` (which causes the data support), `next_stops` (what to run next).
`paper` has the studies of the paper, `train_recorder` the data that trains record.
"""
