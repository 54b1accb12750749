"""The same rig, made of physics: emulated boxes, sensors, subjects, scenes."""
