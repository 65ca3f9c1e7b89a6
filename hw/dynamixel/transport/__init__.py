"""The wire: a serial port, the half-duplex bus on it, and registers that are read from many servos at once."""
