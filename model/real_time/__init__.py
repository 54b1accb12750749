"""NumPy twins of the viewer's shaders."""
