"""The contracts of the hardware abstraction layer: body, control, world and task."""
