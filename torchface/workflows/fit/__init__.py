"""A rig from photographs."""
