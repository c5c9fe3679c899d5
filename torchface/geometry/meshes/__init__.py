"""Triangle meshes: operators, nearest points, deformation gradients, contact, texture space."""
