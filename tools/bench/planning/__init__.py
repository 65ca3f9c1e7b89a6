"""Plans measured in closed loop."""
