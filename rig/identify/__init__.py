"""What measured data says about the model: what is wrong, why, and a model that is better.

Reading order: `dataset` (the data, checked), `preparation` (smooth inputs and covariates),
`replay` (the filters), `candidates` (mechanisms as changes of the replay), `tuning` (fits),
`simulate` (clean data of the same design), `evidence` (the decision), `unknown` (what no mechanism
explains), `gain`, `planning`, `extension`, `creep_curve`, `explain` (all in order), `report`.
"""
