"""Registration of images: tracks, dense flow, strain and head motion."""

from reconstruction.registration.tracking import RegistrationError, Tracks, evened, textured, track

__all__ = ["RegistrationError", "Tracks", "evened", "textured", "track"]
