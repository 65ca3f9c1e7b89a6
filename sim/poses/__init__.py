"""Still poses of a robot: what they weigh on its servos, and which ones reach given places."""
