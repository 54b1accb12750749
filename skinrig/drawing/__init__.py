"""Draw PNG images, SVG figures and labels."""
