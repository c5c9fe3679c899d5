"""Errors of a solved performance against the true one: in weights, at the markers, over the whole mesh."""

from torchface.evaluation.error_figures import ErrorFigures, error_figures, region_figures
from torchface.evaluation.mesh_errors import (
    MeshError,
    RigidAlignment,
    marker_rmse,
    mesh_error,
    moved_vertices,
    rigidly_aligned,
    vertex_errors,
)
from torchface.evaluation.weight_errors import ShapeErrors, WeightError, shape_errors, weight_error, weight_jitter

__all__ = [
    "ErrorFigures",
    "MeshError",
    "RigidAlignment",
    "ShapeErrors",
    "WeightError",
    "error_figures",
    "marker_rmse",
    "mesh_error",
    "moved_vertices",
    "region_figures",
    "rigidly_aligned",
    "shape_errors",
    "vertex_errors",
    "weight_error",
    "weight_jitter",
]
