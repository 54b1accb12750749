"""Models fitted to maps of sessions."""
