"""What train recorders hold, speeds without load and torque: recording, faults, rolling, slides, verdict."""
