"""Pyserial URL handlers of the simulator."""
