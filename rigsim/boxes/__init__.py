"""Emulated controllers: state, command table and advance(dt)."""
