"""Export sessions."""
