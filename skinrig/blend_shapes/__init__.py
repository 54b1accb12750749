"""Blend-shape meshes: glTF and OBJ readers."""
