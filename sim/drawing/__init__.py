"""What draws robots: their shapes."""
