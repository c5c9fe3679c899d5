"""Blendshape weights as files: plain CSV and Live Link Face's."""
