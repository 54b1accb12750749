"""Drivers: the wire format, the port, one thin driver for each box, and cameras."""
