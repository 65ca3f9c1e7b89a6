"""Learning from a teacher: what it would do wherever its pupil comes (DAgger)."""
