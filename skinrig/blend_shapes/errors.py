"""What may be wrong with a mesh that has blend shapes."""


class BlendShapeError(ValueError):
    """A mesh, or weights of its shapes, that contradict themselves."""


class BlendShapeFileError(BlendShapeError, OSError):
    """A file of a mesh that cannot be read."""
