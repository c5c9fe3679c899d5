"""Frames of weights sent over a network: Live Link Face, VMC, plain OSC."""
