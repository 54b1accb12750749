"""Drive the rig, know its errors, keep the frames."""
