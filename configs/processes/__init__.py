"""How processes are started, watched and stopped, and which packages they need not load."""
