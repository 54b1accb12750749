"""Lumitexels: visible (light, view) samples of surface points."""

from reconstruction.lumitexels.samples import CameraProjection as CameraProjection
from reconstruction.lumitexels.samples import LightSources as LightSources
from reconstruction.lumitexels.samples import Lumitexels as Lumitexels
from reconstruction.lumitexels.samples import SampledSurface as SampledSurface
from reconstruction.lumitexels.samples import Visibility as Visibility
from reconstruction.lumitexels.samples import compute_visibility as compute_visibility
