"""Export simulated sessions as scenes of the renderer Mitsuba."""
