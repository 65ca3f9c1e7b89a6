"""Plans that are made beside the loop: who makes them, when they are asked for, and which one runs."""
