"""The least capture that reaches an error, and the error that a capture gives."""
