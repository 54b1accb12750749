"""Run plans on the fiber probe."""
