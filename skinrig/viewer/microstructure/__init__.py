"""Build the microstructure assets of the viewer."""
