"""Tasks that are about skills: to perform them, to kick a ball, to get up."""
