"""Rig, plan and subject to a scene that holds only what it needs."""
