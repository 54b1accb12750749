"""Voxel skin below a boundary: the integrator `tissue`."""
