"""Figures of a head model, after the thesis's figures 20 and 21."""

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.modeling.morphable.head_model import HeadModel
from torchface.rendering.clay_shading import Lighting
from torchface.rendering.compositing import caption, sheet
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER, face_views

_HEADS = 12
_DEVIATIONS = 3.0
_WIDTH, _HEIGHT = 220, 275
_LIGHT = Lighting(occlusion_rays=0)  # seventy faces a model: shadows in creases would take most of the time


def modes_figure(model: HeadModel, count: int = 5) -> Tensor:
    """The mean between -3σ and +3σ of the first modes of shape, a row a mode, each from two sides (figure 20)."""
    rows = []
    for mode in range(min(count, model.shape.count)):
        row = []
        for amount in (-_DEVIATIONS, 0.0, _DEVIATIONS):
            coefficients = torch.zeros(model.shape.count)
            coefficients[mode] = amount
            label = "mean" if amount == 0 else f"mode {mode + 1}, {amount:+g} sd"
            row.append(head_views(model, model.mesh(coefficients), label))
        rows += row
    return sheet(rows, 3)


def random_figure(model: HeadModel, seed: int = 0) -> Tensor:
    """Random heads of the model (figure 21), (3,H,W)."""
    generator = torch.Generator().manual_seed(seed)
    heads = [random_head(model, generator) for _ in range(_HEADS)]
    return sheet([head_views(model, mesh, None, (THREE_QUARTER,)) for mesh in heads], 6)


def random_head(model: HeadModel, generator: torch.Generator) -> Mesh:
    """A head drawn from the model, with colours where it has some."""
    shape = model.shape.sample(1, generator)[0]
    return model.mesh(shape, None if model.color is None else model.color.sample(1, generator)[0])


def head_views(
    model: HeadModel, mesh: Mesh, label: str | None, yaws: tuple[float, ...] = (FRONT, THREE_QUARTER)
) -> Tensor:
    """A head from several sides, (3,H,W), framed as every head of the model is, so that its size shows."""
    row = face_views(mesh, yaws, width=_WIDTH, height=_HEIGHT, framed_by=_room(model), lighting=_LIGHT)
    return row if label is None else caption(row, label)


def _room(model: HeadModel) -> Mesh:
    """A mesh as large as heads of the model get: the mean's vertices, three deviations of each out of its middle."""
    mean = model.shape.mean
    deviation = model.shape.modes.square().sum(0).sqrt()
    return Mesh(mean + 3 * deviation * (mean - mean.mean(0)).sign(), model.faces)
