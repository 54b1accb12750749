"""Simulated rigs: emulated controllers, sensors, subjects and scenes."""
