"""The line between a control loop and its page: copies of ticks one way, requests the other."""
