"""What is estimated: parameter classes, forward equations, the APPEARANCE/ format."""
