"""`servoid bringup`: from a box of servos to a robot that may walk, a module a verb. docs/bringup.md walks through."""
