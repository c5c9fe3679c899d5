"""Head pose and blendshape weights from one ordinary camera without markers."""
