"""Memory and disk of long work: forecasts, and what is free."""
