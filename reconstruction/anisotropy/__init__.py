"""Anisotropy of subsurface scattering from the probe's profiles."""
