"""Recordings of trains, with speeds but without loads and torques: faults, rolling wheels, slides, verdict."""
