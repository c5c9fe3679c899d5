"""The 68 landmarks as points of a rig: inner ones are vertices, those of the contour slide to where the face ends."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchface.correctives.activation import CorrectiveActivation
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.sliding_contour import LevelCurves, level_curves, outermost
from torchface.geometry.meshes.operators import components
from torchface.number_checks import as_tensor
from torchface.rig import BlendshapeRig

LANDMARKS = 68
JAW = 17
"""How many of the 68 landmarks trace the face's contour; they come first."""
EYE_CORNERS = (36, 45)
"""The eyes' outer corners among the 68."""

_SPACING = 3.0  # millimetres


@dataclass(frozen=True, eq=False)
class FacePoints:
    """P points that follow N weights: the landmarks, and the curves that the contour's ones slide along."""

    rest: Tensor  # (P,3), millimetres; the first 68 rows are the landmarks' own vertices
    basis: Tensor  # what a unit of each weight adds, (P,3,N)
    rows: Tensor  # which points each contour landmark may be, (J,C) into P; the first is the landmark itself
    valid: Tensor  # which of them count, (J,C) bool
    side: Tensor  # of the face, +1 toward positive x, (J,)
    # activation, corrective_basis: of C correctives, and what a unit of each adds, (P,3,C); none if absent
    activation: CorrectiveActivation | None = None
    corrective_basis: Tensor | None = None

    @staticmethod
    def of(rig: BlendshapeRig, landmark_vertices: Tensor, slides: bool = True) -> "FacePoints":
        """Those of a rig whose landmarks are the vertices (68,), float64; those of the contour slide or stay,
        visible or not."""
        count = len(rig.vertices)
        marks = as_tensor("landmark_vertices", landmark_vertices, f"({LANDMARKS},)", torch.int64)
        marks = marks.detach().long().to(rig.vertices.device)
        if marks.shape != (LANDMARKS,):
            raise ShapeError(f"landmark_vertices: found {tuple(marks.shape)}, expected ({LANDMARKS},)")
        if int(marks.min()) < 0 or int(marks.max()) >= count:
            raise ValueRangeError(
                f"landmark_vertices: found {int(marks.min())} to {int(marks.max())}, expected ids below {count}"
            )
        correctives = [] if rig.correctives is None else [rig.correctives.deltas]
        stacked = torch.cat([rig.vertices[None], rig.deltas, *correctives]).detach()
        if not slides:
            values = stacked[:, marks].double()
            vertex = torch.arange(JAW, device=marks.device)[:, None]
            every, middle = torch.ones_like(vertex, dtype=torch.bool), marks.new_zeros(JAW).double()
            return FacePoints._made(rig, values, vertex, every, middle)
        x, y = rig.vertices[:, 0].abs(), rig.vertices[:, 1]
        wing, top, bottom = float(x[marks[[31, 35]]].max()), float(y[marks[27]]), float(y[marks[33]])
        nose = (x < 1.2 * wing) & (y < top) & (y > bottom - 0.1 * (top - bottom))
        faces = rig.neutral.faces
        part = components(faces, count)
        skin = torch.isin(part, part[marks])[faces[:, 0]]  # no hair, clothes and other heads, which reach further out
        curves = _thinned(level_curves(rig.vertices, faces[skin & ~nose[faces].any(1)], marks[:JAW]), rig.vertices)
        used, place = torch.cat([marks.cpu(), curves.vertices.flatten()]).unique(return_inverse=True)
        values = stacked[:, used.to(marks.device)].double().cpu().transpose(0, 1)
        local = replace(curves, vertices=place[LANDMARKS:].reshape(curves.vertices.shape))
        on_curves = local.interpolate(values).flatten(0, 1)
        points = torch.cat([values[place[:LANDMARKS]], on_curves]).transpose(0, 1).to(marks.device)
        rows = LANDMARKS + torch.arange(curves.valid.numel()).reshape(curves.valid.shape)
        # A point that is valid keeps its place; the others are never asked for.
        kept = torch.cat([torch.arange(LANDMARKS), rows[curves.valid]])
        compact = torch.zeros(LANDMARKS + curves.valid.numel(), dtype=torch.long)
        compact[kept] = torch.arange(len(kept))
        return FacePoints._made(
            rig,
            points[:, kept.to(marks.device)],
            compact[rows].to(marks.device),
            curves.valid.to(marks.device),
            curves.side.to(marks.device),
        )

    @staticmethod
    def _made(rig: BlendshapeRig, values: Tensor, rows: Tensor, valid: Tensor, side: Tensor) -> "FacePoints":
        basis = values[1:].permute(1, 2, 0).contiguous()
        shapes = len(rig.names)
        made = FacePoints(values[0].contiguous(), basis[..., :shapes].contiguous(), rows, valid, side)
        if rig.activation is None:
            return made
        more = basis[..., shapes:].contiguous()
        return replace(made, activation=copy.deepcopy(rig.activation), corrective_basis=more)

    def at(self, weights: Tensor) -> Tensor:
        """Positions (B,P,3) at weights (B,N)."""
        moved = weights @ self.basis.flatten(0, 1).T
        if self.activation is not None and self.corrective_basis is not None:
            moved = moved + self.activation(weights) @ self.corrective_basis.flatten(0, 1).T
        return self.rest + moved.unflatten(1, self.rest.shape)

    def linearised(self, weights: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Some points (B,L) at weights (B,N), (B,L,3), and what a unit more of each weight adds there, (B,L,3,N)."""
        basis = self.basis[rows]
        placed = self.rest[rows] + (basis.flatten(1, 2) @ weights[..., None]).view(*rows.shape, 3)
        if self.activation is None or self.corrective_basis is None:
            return placed, basis
        more = self.corrective_basis[rows].flatten(1, 2)
        placed = placed + (more @ self.activation(weights)[..., None]).view(placed.shape)
        return placed, basis + (more @ self.activation.jacobian(weights)).view(basis.shape)

    def chosen(self, weights: Tensor, rotation: Tensor, translation: Tensor, intrinsics: Tensor) -> Tensor:
        """Which point each landmark is in each frame, rows (B,68) into the points.

        A contour landmark is the point of its curve that is seen furthest out, away from the face's own vertical; on
        the near side of a turned face that is the landmark's own vertex.
        """
        rows = torch.arange(LANDMARKS, device=weights.device).expand(len(weights), -1)
        if self.rows.shape[1] == 1:
            return rows
        image = self.at(weights) @ (intrinsics @ rotation).transpose(-1, -2) + (translation @ intrinsics.T)[:, None]
        pixels = (image[..., :2] / image[..., 2:])[:, self.rows]
        # The image's direction at right angles to the face's vertical, toward its positive x.
        across = torch.stack([-rotation[:, 1, 1], rotation[:, 0, 1]], dim=-1)
        across = torch.where((across * rotation[:, :2, 0]).sum(-1, keepdim=True) < 0, -across, across)
        best = outermost(pixels, self.valid, across[:, None] * self.side[:, None])
        slid = self.rows.expand(len(weights), -1, -1).gather(2, best[..., None])[..., 0]
        return torch.cat([torch.where(best > 0, slid, rows[:, :JAW]), rows[:, JAW:]], dim=1)

    def eyes_distance(self, rotation: Tensor, translation: Tensor, intrinsics: Tensor) -> Tensor:
        """How far apart a camera straight ahead would see the eyes' outer corners, (B,), pixels, from (B,3,3) and
        (B,3)."""
        right, left = (self.rest[i] for i in EYE_CORNERS)
        apart = (right - left).norm()
        depth = rotation[:, 2] @ (0.5 * (right + left)) + translation[:, 2]
        # A pose gone astray puts the eyes at no distance at all.
        return 0.5 * (intrinsics[0, 0] + intrinsics[1, 1]) * apart / torch.maximum(depth, apart)


def make_room_for_points(
    solver: nn.Module, state: Mapping[str, Any], prefix: str = "", more: Sequence[str] = ()
) -> None:
    """Gives a solver's buffers of points the sizes that a state has them in, where these fit one another.

    Another rig's contour may have more or fewer points. What does not fit is left to ``load_state_dict`` to refuse.
    """
    by_point, by_curve = ("rest", "basis", *more), ("rows", "valid")
    tensors = {name: state.get(prefix + name) for name in (*by_point, *by_curve)}
    shapes = {name: tuple(value.shape) for name, value in tensors.items() if isinstance(value, Tensor)}
    count, curve = (shapes.get(name, (0, 0))[axis] for name, axis in (("rest", 0), ("rows", -1)))
    expected = {name: (count, *getattr(solver, name).shape[1:]) for name in by_point}
    expected |= dict.fromkeys(by_curve, (JAW, curve))
    if shapes == expected and count >= LANDMARKS:
        for name, shape in shapes.items():
            buffer = getattr(solver, name)
            if buffer.shape != shape:
                setattr(solver, name, buffer.new_zeros(shape))


def _thinned(curves: LevelCurves, vertices: Tensor) -> LevelCurves:
    """The curves with points no closer than a few millimetres; round as a face is, its edge moves by hundredths."""
    points = curves.interpolate(vertices.detach().double().cpu())
    kept = torch.zeros_like(curves.valid)
    for i, (line, valid) in enumerate(zip(points, curves.valid, strict=True)):  # curves are few, of own lengths
        rows = valid.nonzero()[1:, 0]
        order = rows[(line[rows] - line[0]).norm(dim=-1).argsort()]
        cells = ((line[order] - line[0]).norm(dim=-1) / _SPACING).long()
        first = torch.ones_like(cells, dtype=torch.bool)
        first[1:] = cells[1:] != cells[:-1]
        kept[i, order[first]] = True
    kept[:, 0] = True
    count = int(kept.sum(1).max())
    # Stable, so that the start stays first.
    place = kept.long().argsort(dim=1, descending=True, stable=True)[:, :count]
    ends = curves.vertices.gather(1, place[..., None].expand(-1, -1, 2))
    return LevelCurves(ends, curves.share.gather(1, place), kept.gather(1, place), curves.side)
