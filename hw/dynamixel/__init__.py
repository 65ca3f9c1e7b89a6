"""Dynamixel servos over Protocol 2.0: control tables, codec, port, bus, and the backend that drives a robot."""
