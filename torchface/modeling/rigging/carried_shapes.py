"""A head with a template's shapes, and what a person has to be warned of in them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.registration import Registration
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping

_OPEN = 0.1  # of an eye: what a blink that shuts it leaves at most
_JAW, _LIP, _BEFORE, _COLUMNS = "jawOpen", 10.0, 100.0, 9  # millimetres behind and before the lips; rays between them
_SEEN_DRAWN, _LEAST_DRAWN = 3.0, 3  # times an edge's length, and edges
_MOUTH, _STRETCHED = (75.0, 25.0), 2.0  # millimetres behind the lips and over them; times an edge's length


@dataclass(frozen=True, eq=False)
class CarriedShapes:
    """A head of its own topology with a template's shapes.

    Args:
        rig: the head, every vertex where it was, with the template's names.
        registration: of the template with the head, in the head's space.
        template: the template's rig on the head's face, in the template's topology, place and size.
        distance: of each of the head's vertices to that face, (V,), millimetres of the template's size.
        places: which vertices have a place on it, (V,) bool; the others follow by smoothness or as loose parts.
        tongue: how much each vertex is of the head's own tongue, (V,) in [0,1]; all zero where it has none.
        open_lids: what the blinks of the right and left eye leave open, as a share of the opening; None where its lids
            cannot be told from the eye, as of painted or welded eyes, and its blink is the template's.
    """

    rig: BlendshapeRig
    registration: Registration
    template: BlendshapeRig
    distance: Tensor
    places: Tensor
    tongue: Tensor
    open_lids: tuple[float | None, ...]

    def notes(self, lips_cut: bool = False, shut: tuple[bool, bool] = (False, False)) -> list[str]:
        """Of eyes that may not shut and lips that do not part, if nobody has cut them, for people to read.

        Args:
            shut: whether the right and left eye are modelled shut.
        """
        named = list(zip(("right", "left"), self.open_lids, strict=True))
        at_rest = [side for (side, _), yes in zip(named, shut, strict=True) if yes]
        unseen = [side for side, left in named if left is None and side not in at_rest]
        notes = [
            f"warning: {side} eye: its blink leaves {left:.0%} of it open"
            for side, left in named
            if (left or 0) > _OPEN
        ]
        if at_rest:
            notes.append(
                f"warning: {' and '.join(at_rest)} eye: modelled shut: eyeBlink moves nothing and eyeWide opens it; "
                "ARKit's shapes expect open eyes at rest"
            )
        if unseen:
            notes.append(
                f"warning: {' and '.join(unseen)} eye: the lids cannot be told from the eye (painted, shut or "
                "one piece with the skin): look whether it shuts"
            )
        if not lips_cut and self._lips_in_one_piece():
            notes.append(
                "warning: the lips are one piece: jawOpen stretches the skin between them; cut the mesh along the lips"
            )
        if between := self._edges_between_jaws():
            notes.append(
                f"warning: {between} edges inside the mouth join both jaws where more than two triangles share an "
                "edge, as in reduced meshes: jawOpen stretches them across the mouth; separate the two rows of teeth"
            )
        return notes

    def _opened(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """The inner lips, and the head at rest and with its jaw open, in the template's place."""
        marks, jaw = marks_of(self.template), mapping(self.rig.names, [_JAW])[0] > 0.5
        if not bool(jaw.any()) or bool(marks.isnan().any()):
            return None
        back = self.registration.pose.inverse()
        rest = back.apply(self.rig.vertices.detach().cpu().double())[0]
        return marks[60:68], rest, rest + back.apply_vectors(self.rig.deltas[jaw][:1].detach().cpu().double())[0]

    def _lips_in_one_piece(self) -> bool:
        """Whether what is seen between the lips of an open mouth is skin that was drawn out."""
        if (opened := self._opened()) is None:
            return False
        lips, rest, posed = opened
        apart = self.template.deltas[mapping(self.template.names, [_JAW])[0] > 0.5][0].detach().cpu().double()
        after = lips + apart[self.template.neutral.landmarks.cpu()[60:68]]  # type: ignore[union-attr]
        share = torch.linspace(0, 1, _COLUMNS, dtype=torch.float64)[:, None]
        upper, lower = (after[a] + share * (after[b] - after[a]) for a, b in ((1, 3), (7, 5)))
        ways = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(_COLUMNS, 3)
        faces = self.rig.neutral.faces.cpu()
        hits = RayCaster(posed, faces).cast((upper + lower) / 2 - _BEFORE * ways, ways)
        near = hits.distance < _BEFORE + _LIP
        ends = faces[hits.triangle[near]]
        drawn = [_drawn(ends[:, [a, b]], rest, posed, _SEEN_DRAWN, 0.0) for a, b in ((0, 1), (1, 2), (0, 2))]
        return int(torch.stack(drawn).any(0).sum()) > _COLUMNS / 2

    def _edges_between_jaws(self) -> int:
        """How many edges behind the lips opening the jaw draws out beside those that more than two triangles share.

        Cheeks and the wall of a mouth are drawn out as far, but there two triangles share an edge.
        """
        if (opened := self._opened()) is None:
            return 0
        lips, rest, posed = opened
        joined = joined_vertices(rest, self.rig.neutral.faces.cpu())
        away = joined.vertices - lips.mean(0)
        inside = (away[:, 2] < 0) & (away.norm(dim=-1) < _MOUTH[0]) & (away[:, 1].abs() < _MOUTH[1])
        # A face of two sides counts once.
        faces = joined.faces[inside[joined.faces].all(1)].sort(1).values.unique(dim=0)
        faces = faces[(faces[:, :2] != faces[:, 1:]).all(1)]
        pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [0, 2]]])
        ends, count = pairs.unique(dim=0, return_counts=True)
        after = torch.zeros_like(joined.vertices)
        after[joined.of] = posed
        shared = torch.isin(ends, ends[count > 2]).any(1)
        found = int((_drawn(ends, joined.vertices, after, _STRETCHED, _LIP) & shared).sum())
        return found if found >= _LEAST_DRAWN else 0


def _drawn(ends: Tensor, rest: Tensor, posed: Tensor, times: float, least: float) -> Tensor:
    """Which edges (E,) a pose makes longer by so many times and by so many millimetres."""
    before, after = ((one[ends[:, 0]] - one[ends[:, 1]]).norm(dim=-1) for one in (rest, posed))
    return (after > times * before) & (after - before > least)


def marks_of(rig: BlendshapeRig) -> Tensor:
    """iBUG's 68 of a rig, (68,3); NaN where it does not know them."""
    notes = rig.neutral.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != 68:
        return torch.full((68, 3), torch.nan, dtype=torch.float64)
    return rig.vertices.detach().cpu().double()[notes.landmarks.cpu()]
