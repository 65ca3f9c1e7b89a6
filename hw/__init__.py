"""Hardware abstraction layer: contracts, robot description and what speaks to motors."""
