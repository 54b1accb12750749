"""Build the assets of the viewer's page."""
