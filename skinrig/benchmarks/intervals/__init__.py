"""Coverage of credible intervals over simulated sessions."""
