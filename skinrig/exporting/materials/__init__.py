"""Exports of materials and meshes."""
