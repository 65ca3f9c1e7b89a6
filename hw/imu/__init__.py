"""IMUs: on a port of their own or the board's on the servo bus; all end as the same reading in the base frame."""
