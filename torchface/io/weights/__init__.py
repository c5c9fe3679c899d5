"""Blendshape weights as files and as packets: plain CSV, Live Link Face."""
