"""Time, and the composition of everything into a bench."""
