"""The bench as a Modbus server: map, process image, TCP, RTU and TLS."""
