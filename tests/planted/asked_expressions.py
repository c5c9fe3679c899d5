"""Expressions that a person is asked for, as combinations of ARKit's shapes."""

EXAMPLES = [
    "mouthSmileLeft mouthSmileRight browInnerUp eyeLookUpLeft eyeLookUpRight jawForward",
    "jawOpen mouthRight browDownLeft browDownRight eyeLookDownLeft eyeLookDownRight",
    "mouthPucker jawLeft eyeBlinkLeft eyeBlinkRight noseSneerLeft",
    "mouthFrownLeft mouthFrownRight mouthShrugLower mouthShrugUpper browOuterUpLeft eyeWideLeft eyeWideRight",
    "mouthStretchLeft mouthStretchRight mouthRollLower mouthRollUpper cheekSquintLeft cheekSquintRight eyeSquintLeft "
    "eyeSquintRight",
    "cheekPuff mouthPressLeft mouthPressRight jawRight browOuterUpRight eyeLookInLeft eyeLookOutRight",
    "mouthUpperUpLeft mouthUpperUpRight mouthLowerDownLeft mouthLowerDownRight noseSneerRight eyeLookOutLeft "
    "eyeLookInRight",
    "mouthFunnel mouthLeft mouthDimpleLeft mouthDimpleRight browDownLeft",
]
"""What the person is asked to do, each shape at 0.9: every shape once, apart from others that move the same skin."""
