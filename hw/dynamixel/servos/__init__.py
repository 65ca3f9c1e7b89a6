"""The servos: who is there, what their registers hold and must hold, and what goes wrong silently."""
