"""Recordings of trains, with speeds but no loads or torques: faults, radii, slides, verdict."""
