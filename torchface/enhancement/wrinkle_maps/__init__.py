"""Few maps of an actor's wrinkles for engines, and their weights for a rig's poses."""
