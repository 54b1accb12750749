"""Displacement synthesis: texture growth of skin microstructure."""
