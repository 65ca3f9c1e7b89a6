"""The operator's page: what a robot does, in a browser, and what a person asks of it there."""
