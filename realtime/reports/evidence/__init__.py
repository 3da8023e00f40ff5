"""The evidence of a test programme and of the rig itself."""
