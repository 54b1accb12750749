"""Renderings compared with held-out photographs."""
