"""How processes are started, watched and ended, and what they need not load."""
