"""The page's own process: what it serves to browsers, what it draws, and who may ask what."""
