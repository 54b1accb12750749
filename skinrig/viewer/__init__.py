"""The live viewer: one self-contained WebGL2 page with the real-time systems of the papers."""
