"""Instrument drivers: wire format, serial port, one driver per controller, and cameras."""
