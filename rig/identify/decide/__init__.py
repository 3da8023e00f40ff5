"""Decides which causes the data support, and what they are worth.

Reading order: `decision` (all steps in their order), `fitting` (fits of an explanation),
`null_simulations` and `simulate` (what is ordinary), `evidence` (score tests), `choice` (one cause
or two) with `shapes`, `gain` (on runs that were never fitted), `empirical` (a formula for the
rest), `estimates` and `notes` (what reports show). All limits are in `thresholds`.
"""
