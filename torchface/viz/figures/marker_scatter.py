"""Markers against the points of the mesh that stand for them, from the front and the side (the thesis's figure 59)."""

from __future__ import annotations

from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from torchface.rendering.compositing import from_figure


def marker_views(markers: Tensor, on_mesh: Tensor, title: str = "") -> Tensor:
    """One frame: seen markers (M,3), NaN where not seen, joined to their points on the mesh (M,3); (3,H,W)."""
    figure = Figure(figsize=(10, 5), dpi=100, layout="constrained")
    seen = markers.isfinite().all(-1)
    error = (markers - on_mesh)[seen].norm(dim=-1)
    for axes, (name, across) in zip(figure.subplots(1, 2), (("front", 0), ("side", 2)), strict=True):
        columns = [across, 1]
        pairs = [
            [a.tolist(), b.tolist()] for a, b in zip(markers[seen][:, columns], on_mesh[seen][:, columns], strict=True)
        ]
        axes.add_collection(LineCollection(pairs, colors="grey", linewidths=1))
        axes.scatter(*on_mesh[:, columns].T, marker="x", s=22, color="#1f5fa8", label="mesh", linewidths=1)
        axes.scatter(*markers[seen][:, columns].T, marker="+", s=28, color="#c8321e", label="marker", linewidths=1)
        axes.set(title=name, xlabel="mm", aspect="equal")
        if name == "side":  # the face looks to the left, as in a profile from the viewer's right
            axes.invert_xaxis()
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.suptitle(f"{title} mean distance {float(error.mean()):.2f} mm, {int((~seen).sum())} not seen".strip())
    return from_figure(figure)
