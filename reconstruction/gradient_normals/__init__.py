"""Normals from polarized spherical-gradient patterns."""

from reconstruction.gradient_normals.estimation import Roughness, estimate_roughness, from_patterns
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.gradient_normals.patterns import GradientError, MissingPatternsError
from reconstruction.gradient_normals.sphere_lights import SphereLights, SphereLightsError

__all__ = [
    "GradientError",
    "MissingPatternsError",
    "Roughness",
    "SensorNoise",
    "SphereLights",
    "SphereLightsError",
    "estimate_roughness",
    "from_patterns",
]
