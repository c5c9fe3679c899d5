"""A face in a video as weights of the actor's rig."""
