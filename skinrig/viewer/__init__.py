"""Build the live viewer: one self-contained WebGL2 page with the papers' real-time systems."""
