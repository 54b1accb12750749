"""Lumitexels: visible (light, view) samples of surface points."""

from reconstruction.lumitexels.samples import (
    Camera,
    Lights,
    Lumitexels,
    Surface,
    Visibility,
    visibility,
)

__all__ = ["Camera", "Lights", "Lumitexels", "Surface", "Visibility", "visibility"]
