"""Build the sections, images and tables of the report."""
