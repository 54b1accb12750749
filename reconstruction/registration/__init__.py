"""Registration of images: tracks, dense flow, strain and head motion."""

from reconstruction.registration.tracking import RegistrationError as RegistrationError
from reconstruction.registration.tracking import Tracks as Tracks
from reconstruction.registration.tracking import (
    normalize_local_contrast as normalize_local_contrast,
)
from reconstruction.registration.tracking import textured as textured
from reconstruction.registration.tracking import track as track
from reconstruction.registration.tracking import within as within
