"""What a recorder or a sensor did wrong: each fault is found, and taken out."""
