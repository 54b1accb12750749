"""Lumitexels: visible (light, view) samples of surface points."""

from reconstruction.lumitexels.samples import Camera as Camera
from reconstruction.lumitexels.samples import Lights as Lights
from reconstruction.lumitexels.samples import Lumitexels as Lumitexels
from reconstruction.lumitexels.samples import Surface as Surface
from reconstruction.lumitexels.samples import Visibility as Visibility
from reconstruction.lumitexels.samples import visibility as visibility
