"""The devices of the rig as seen from the bus: tables and state machines, no physics."""
