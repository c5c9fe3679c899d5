"""Where markers sit on a rig, found from ranges of motion."""
