"""The bench as a Modbus server: the map of registers, the units, and TCP, RTU and TLS."""
