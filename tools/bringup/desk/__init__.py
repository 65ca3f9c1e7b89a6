"""Where the person of a verb of bring-up is: at the terminal that it was started in, or at the page."""
