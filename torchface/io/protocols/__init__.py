"""Faces sent and received over a network: Live Link Face, VMC, OSC, iFacialMocap, VRChat, VTube Studio."""
