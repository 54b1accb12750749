"""Export sessions, maps, materials, meshes and reflectance tables to other programs."""
