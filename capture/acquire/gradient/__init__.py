"""Run plans on the gradient sphere and its caliper."""
