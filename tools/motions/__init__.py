"""`servoid motions`: where clips come from, and what becomes of them."""
