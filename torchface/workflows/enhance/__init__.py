"""From a coarse animation and an actor's model on disk to the same animation with the actor's wrinkles."""
