"""LeRobot v3.0 datasets: written, appended to, read and shown."""
