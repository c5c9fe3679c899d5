"""Rays against meshes, and images of meshes, lights and paint."""
