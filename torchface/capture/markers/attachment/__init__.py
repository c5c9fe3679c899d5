"""Sites of markers on a rig: first guess, fit to a range of motion, uncertainty, refusal."""
