"""Drawing: PNG images, SVG figures and labels."""
