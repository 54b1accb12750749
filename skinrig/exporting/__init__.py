"""What is handed to other programs: sessions, maps, materials, meshes and reflection tables."""
