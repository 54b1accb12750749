"""The renderer's error."""


class RenderError(RuntimeError):
    """Mitsuba returned an unusable image, or cannot be started."""
