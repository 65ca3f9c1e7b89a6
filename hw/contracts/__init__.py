"""The contracts of the hardware abstraction layer: body, backend, control, world and task."""
