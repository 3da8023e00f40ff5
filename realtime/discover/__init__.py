"""The loop that runs stops, explains them and proposes the next stops, and the sealed rigs that test it."""
