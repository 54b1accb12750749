"""The pipeline: recipes that turn a session into an appearance."""
