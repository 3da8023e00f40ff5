"""Decides which causes the data support, and what they are worth.

Reading order: `decision` (all steps in their order), `fitting` (fits of an explanation),
`null_simulations` (what is ordinary), `evidence` (score tests), `smallest` (sizes that these runs
would show), `choice` (one cause or two) with `shapes`, `coherence` (whether a cause shows the same
everywhere), `gain` (on runs that were never fitted), `empirical` (a formula for the rest),
`estimates` and `notes` (what reports show). All limits are in `thresholds`.
"""
