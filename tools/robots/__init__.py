"""What belongs to a robot: its file, its gait, its servos."""
