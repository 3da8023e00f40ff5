"""The roller drives: CiA 402 state machine, objects, demand, torque control."""
