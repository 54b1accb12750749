"""Estimators from camera colors together with signals under narrow-band LEDs."""
