"""From a webcam's picture to blendshape weights: one graph, and what runs it."""
