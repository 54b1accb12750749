"""Exports to other programs: sessions, maps, materials, meshes and reflectance tables."""
