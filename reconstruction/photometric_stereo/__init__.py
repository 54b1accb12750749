"""Photometric stereo: normals and albedo from a stack of lights."""

from reconstruction.normal_maps import NormalMaps as NormalMaps
from reconstruction.normal_maps import PhotometricStereoError as PhotometricStereoError
from reconstruction.photometric_stereo.estimation import Robustness as Robustness
from reconstruction.photometric_stereo.estimation import estimate_normals as estimate_normals
from reconstruction.photometric_stereo.estimation import require_noncoplanar as require_noncoplanar
