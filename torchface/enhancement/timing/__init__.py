"""The actor's timing of motions between keyframes."""
