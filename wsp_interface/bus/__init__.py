"""CAN: frames, kernel buses, the hub and its protocols, the python-can plugin."""
