"""Assets of the viewer's page."""
