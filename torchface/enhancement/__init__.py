"""A coarse animation gets a captured actor's fine detail and timing."""
