"""The reference WSP: its control law, and the unit on the bus that runs it."""
