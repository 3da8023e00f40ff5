"""The devices of the rig as seen from the bus: object tables and state machines, no physics."""
