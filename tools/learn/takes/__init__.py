"""Takes that a planner learns from: made of clips and walks, authored toward random places, executed in physics."""
