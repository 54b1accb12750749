"""Studies: many simulated sessions, each judged against its ground truth."""
