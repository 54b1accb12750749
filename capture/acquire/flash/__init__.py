"""Run plans on the flash rig."""
