"""What calibration by hand needs: encoders that stand still, hands that move joints, and which way is meant."""
