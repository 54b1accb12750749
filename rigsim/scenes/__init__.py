"""Scenes of the rigs: rig, plan and subject to images with the required effects only."""
