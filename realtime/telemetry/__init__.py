"""Everything that Rerun draws: recorder, live view, blueprints, pictures."""
