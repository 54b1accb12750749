"""Scan meshes: repair, parameterization and registration."""
