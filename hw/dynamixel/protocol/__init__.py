"""Protocol 2.0 and the control tables: bytes to packets, registers to numbers, servo units to joint units."""
