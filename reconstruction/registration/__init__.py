"""Registration of images: tracks, dense flow, strain and head motion."""

from reconstruction.registration.tracking import (
    RegistrationError,
    Tracks,
    normalize_local_contrast,
    textured,
    track,
)

__all__ = ["RegistrationError", "Tracks", "normalize_local_contrast", "textured", "track"]
