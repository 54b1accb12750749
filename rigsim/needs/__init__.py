"""Effects that a scene needs, and effects that it omits by a measured rule."""
