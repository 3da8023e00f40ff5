"""The border of the rig: what an outside unit or harness may rely on."""
