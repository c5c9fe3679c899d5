"""Stages that video, scan and mark a head as real equipment does, with the truth beside it."""
