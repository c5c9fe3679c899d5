"""Sites of markers on a rig, found from ranges of motion."""
