"""Registration of images: tracks, dense flow, strain and head motion."""

from reconstruction.registration.tracking import RegistrationError as RegistrationError
from reconstruction.registration.tracking import Tracks as Tracks
from reconstruction.registration.tracking import is_inside_image as is_inside_image
from reconstruction.registration.tracking import (
    normalize_local_contrast as normalize_local_contrast,
)
from reconstruction.registration.tracking import select_textured_points as select_textured_points
from reconstruction.registration.tracking import track_points as track_points
