"""Evidence, choice and gain: which causes the data ask for, and what they are worth."""
