"""The loop that runs stops, explains them and proposes the next ones; sealed rigs to test it."""
