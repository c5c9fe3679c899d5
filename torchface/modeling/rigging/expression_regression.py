"""Expressions from a neutral face alone: what has been learned from other people's faces and expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchface.errors import NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.modeling.morphable.principal_components import PrincipalComponents, principal_components
from torchface.modeling.rigging.component_choice import choose_components
from torchface.modeling.rigging.deformation_transfer import transfer_deformation
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping

NEUTRAL_COMPONENTS, OFFSET_COMPONENTS = 14, 13
Form = Literal["offsets", "expressions"]

_STILL = 1e-4  # millimetres; what rounding of positions to float32 leaves of a vertex that does not move
# Of the vertex that moves most. The form of ears and neck predicts little of a smile, and would fill the components.
_MOVES = 0.05


class ExpressionRegression(nn.Module):
    r"""Predicts a person's expressions from the form of the neutral face.

    .. math:: X = (N - \bar N) \, N_{PCA}, \quad Y = X B, \quad \Delta = \bar\Delta + Y \, \Delta_{PCA}^\top

    with B of least squares. What is predicted are offsets :math:`\Delta = S - N` (the form "offsets"); in the form
    "expressions" it is S itself, as the thesis tries first: there the identity that 13 components cannot hold leaks
    away, and it is here for comparison.

    A neutral face may have any pose: it is laid onto the mean neutral first, rotation and translation only, and
    what is predicted is rotated back. N is the part of the neutral that moves in some expression. Vertices that no
    example moves are not stored and stay exactly where they are.

    Args:
        vertices: V.
        names: of the N expressions.
        region: how many of the vertices the prediction depends on.
        moving: how many of the N·V places are predicted.
        neutral_components, offset_components: of the two bases.
        topology: ``Mesh.fingerprint()`` of the faces learned from, checked where given.
        form: "offsets" or "expressions".

    Source: thesis 3.3.4, equations 30 to 32.

    Example:
        >>> from torchface import zoo
        >>> from torchface.synthetic import neutral_head
        >>> regression = zoo.get_model("expressions")
        >>> head = neutral_head(texture=False)
        >>> open_jaw = regression(head.vertices[None])[0, regression.names.index("jawOpen")]
        >>> bool(open_jaw[head.landmarks[8], 1] < head.vertices[head.landmarks[8], 1] - 10)
        True
    """

    neutral_mean: Tensor
    region: Tensor
    neutral_components: Tensor
    offset_mean: Tensor
    offset_components: Tensor
    coefficients: Tensor
    places: Tensor

    def __init__(
        self,
        vertices: int,
        names: Sequence[str],
        region: int,
        moving: int,
        neutral_components: int,
        offset_components: int,
        topology: str | None = None,
        form: Form = "offsets",
    ) -> None:
        super().__init__()
        if form not in ("offsets", "expressions"):
            raise ValueRangeError(f"form: found {form!r}, expected 'offsets' or 'expressions'")
        words = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
        if not words or len(set(names)) < len(names) or not names:
            raise NameMismatchError(f"names: found {names!r:.80}, expected distinct names, one at least")
        self.names: tuple[str, ...] = tuple(names)
        self.topology, self.form = topology, form
        self.register_buffer("neutral_mean", torch.zeros(vertices, 3))
        self.register_buffer("region", torch.zeros(region, dtype=torch.int64))
        self.register_buffer("neutral_components", torch.zeros(neutral_components, region, 3))
        self.register_buffer("offset_mean", torch.zeros(moving, 3))
        self.register_buffer("offset_components", torch.zeros(offset_components, moving, 3))
        self.register_buffer("coefficients", torch.zeros(neutral_components, offset_components))
        self.register_buffer("places", torch.zeros(moving, dtype=torch.int64))

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor needs: plain values only."""
        return {
            "vertices": len(self.neutral_mean),
            "names": list(self.names),
            "region": len(self.region),
            "moving": len(self.places),
            "neutral_components": len(self.neutral_components),
            "offset_components": len(self.offset_components),
            "topology": self.topology,
            "form": self.form,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ExpressionRegression:
        """A regression of zeros for the state to be loaded into."""
        return cls(**config)

    @classmethod
    def fit(
        cls,
        neutrals: Tensor,
        expressions: Tensor,
        neutral_components: int | None = NEUTRAL_COMPONENTS,
        offset_components: int | None = OFFSET_COMPONENTS,
        ridge: float | None = 0.0,
        names: Sequence[str] | None = None,
        topology: str | None = None,
        form: Form = "offsets",
        region: Tensor | None = None,
    ) -> ExpressionRegression:
        """Learns from people in correspondence, each with a neutral face and the same expressions.

        Args:
            neutrals: (M,V,3), millimetres, in any pose.
            expressions: (M,N,V,3), each person's in the space of his or her own neutral.
            neutral_components, offset_components: how many, as many as the data hold where these are fewer; None
                has them chosen by leaving out one person after the other.
            ridge: as a share of the neutrals' mean variance a component; None has it chosen alike.
            names: of the expressions; ``expression0``, ... if absent.
            topology: ``Mesh.fingerprint()`` of the faces.
            form: "offsets" (equation 32) or "expressions" (equation 31).
            region: mask (V,) of the vertices to learn from; those that move by a twentieth as far as the one that moves
                most in some expression, if absent; all of them for the form "expressions", as in the thesis.

        Raises:
            ShapeError: the shapes do not fit, or there are fewer people than it takes to see how they differ.
            ValueRangeError: NaN or infinity, neutrals that are all the same, or a negative ridge.
            NameMismatchError: not one name an expression, or one twice.
        """
        names = [f"expression{i}" for i in range(expressions.shape[1])] if names is None else list(names)
        _check_examples(neutrals, expressions, names)
        for what, found in (("neutral_components", neutral_components), ("offset_components", offset_components)):
            if found is not None and found < 1:
                raise ValueRangeError(f"{what}: found {found}, expected 1 at least")
        if ridge is not None and not 0 <= ridge < float("inf"):
            raise ValueRangeError(f"ridge: found {ridge}, expected a finite number of at least 0")
        laid, poses = _laid_together(neutrals)
        predicted = expressions.double() - (neutrals.double()[:, None] if form == "offsets" else 0)
        if form == "offsets":
            predicted = predicted @ poses.rotation.double().transpose(-1, -2)[:, None]
            places = (predicted.abs().amax((0, -1)) > _STILL).flatten().nonzero()[:, 0]
            considered = _moving(predicted) if region is None else region
        else:
            predicted = poses.apply(predicted.flatten(1, 2)).view_as(predicted)
            places = torch.arange(predicted.shape[1] * predicted.shape[2])
            considered = torch.ones(laid.shape[1], dtype=torch.bool) if region is None else region
        if considered.dtype != torch.bool or considered.shape != laid.shape[1:2] or not bool(considered.any()):
            raise ShapeError(
                f"region: found {considered.dtype} {tuple(considered.shape)}, expected a mask (V,), not empty"
            )
        moving = predicted.flatten(1, 2)[:, places].flatten(1).float()
        flat = laid[:, considered].flatten(1).float()
        if neutral_components is None or offset_components is None or ridge is None:
            choice = choose_components(flat, moving, neutral_components, offset_components, ridge)
            neutral_components, offset_components, ridge = choice.inputs, choice.outputs, choice.ridge
        neutral, offset = principal_components(flat), _components_or_mean(moving)
        kept = min(neutral_components, len(neutral.components)), min(offset_components, len(offset.components))
        self = cls(laid.shape[1], names, int(considered.sum()), len(places), *kept, topology, form)
        self.neutral_mean.copy_(laid.mean(0))
        self.region.copy_(considered.nonzero()[:, 0])
        self.neutral_components.copy_(neutral.components[: kept[0]].unflatten(1, (-1, 3)))
        self.offset_mean.copy_(offset.mean.view(-1, 3))
        self.offset_components.copy_(offset.components[: kept[1]].reshape(kept[1], len(places), 3))
        X = (flat.double() - neutral.mean) @ self.neutral_components.flatten(1).double().T
        Y = (moving.double() - offset.mean) @ self.offset_components.flatten(1).double().T
        gram = X.T @ X
        gram.diagonal().add_(ridge * gram.diagonal().mean())
        self.coefficients.copy_(torch.linalg.solve(gram, X.T @ Y))
        self.places.copy_(places)
        return self

    def forward(self, neutrals: Tensor) -> Tensor:
        """Expressions (B,N,V,3) of neutral faces (B,V,3), millimetres, in their own poses.

        Raises:
            ShapeError: the neutrals are not (B,V,3).
        """
        return neutrals[:, None] + self.offsets(neutrals)

    def offsets(self, neutrals: Tensor) -> Tensor:
        """How far each vertex goes in each expression, (B,N,V,3); see :meth:`forward`."""
        if neutrals.ndim != 3 or neutrals.shape[1:] != self.neutral_mean.shape:
            raise ShapeError(f"neutrals: found {tuple(neutrals.shape)}, expected (B,{len(self.neutral_mean)},3)")
        pose = similarity_transform(neutrals, self.neutral_mean.to(neutrals).expand_as(neutrals), scale=False)
        laid = pose.apply(neutrals)
        X = (laid - self.neutral_mean.to(laid))[:, self.region].flatten(1) @ self.neutral_components.flatten(1).T.to(
            laid
        )
        Y = X @ self.coefficients.to(X)
        moving = self.offset_mean.to(Y) + torch.einsum("bk,kpc->bpc", Y, self.offset_components.to(Y))
        whole = moving.new_zeros(len(neutrals), len(self.names) * len(self.neutral_mean), 3)
        whole = whole.index_copy(1, self.places, moving).unflatten(1, (len(self.names), -1))
        if self.form == "expressions":
            whole = whole - laid[:, None]
        return whole @ pose.rotation.to(whole)[:, None]

    def check_state(self) -> None:
        """Raises ``TopologyError`` where a loaded state points to vertices that there are not."""
        for name, ids, count in (
            ("region", self.region, len(self.neutral_mean)),
            ("places", self.places, len(self.names) * len(self.neutral_mean)),
        ):
            if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < count:
                raise TopologyError(f"{name}: found {int(ids.min())} to {int(ids.max())}, expected 0 to {count - 1}")

    def extra_repr(self) -> str:
        bases = f"{len(self.neutral_components)} to {len(self.offset_components)} components"
        return f"{len(self.neutral_mean)} vertices, {len(self.names)} expressions, {bases}, form={self.form}"


def rig_from_neutral(regression: ExpressionRegression, template: BlendshapeRig, neutral: Mesh) -> BlendshapeRig:
    """A whole personal rig from one neutral face.

    Shapes of the template that the regression has, in any spelling that ``shape_names`` reads, are predicted; the
    others come by deformation transfer. A predicted whole is divided between a template's halves as transfer does.

    Args:
        regression: in the template's topology.
        template: N shapes.
        neutral: the person, of the same topology, millimetres, in any pose.

    Returns:
        A rig of ``neutral`` with the template's names in their order.

    Raises:
        TopologyError: regression, template and neutral have not the same topology.
        NameMismatchError: the regression has none of the template's shapes.

    Source: thesis 3.3.4 for predicted shapes, 3.3.1 for the others.

    Example:
        >>> from torchface import zoo
        >>> from torchface.synthetic import performer
        >>> template = performer(texture=False).select(["jawOpen", "mouthSmileLeft"])
        >>> rig = rig_from_neutral(zoo.get_model("expressions"), template, template.neutral)
        >>> rig.names
        ('jawOpen', 'mouthSmileLeft')
    """
    own = neutral.fingerprint()
    for what, found in (("template", template.neutral.fingerprint()), ("regression", regression.topology)):
        if found is not None and found != own:
            raise TopologyError(
                f"rig_from_neutral: found a {what} of topology {found}, expected the neutral's own, {own} "
                "(vertex count, hash of the triangles)"
            )
    if len(regression.neutral_mean) != len(neutral.vertices):
        raise TopologyError(
            f"rig_from_neutral: found a regression of {len(regression.neutral_mean)} vertices, expected the "
            f"neutral's {len(neutral.vertices)}"
        )
    translation = mapping(regression.names, template.names)
    predictable = translation.any(1)
    if not predictable.any():
        raise NameMismatchError(
            f"rig_from_neutral: found a regression of {', '.join(regression.names[:5])}, expected some of the "
            f"template's shapes, {', '.join(template.names[:5])}, ..."
        )
    with torch.no_grad():
        predicted = regression.offsets(neutral.vertices[None].float())[0]
    split = (translation > 0) & ((translation > 0).sum(0) > 1)
    # All of them: a shape that undoes another is transferred on top of it.
    needless = bool(predictable.all()) and not bool(split.any())
    moved = template if needless and template.correctives is None else transfer_deformation(template, neutral)
    transferred = torch.zeros_like(template.deltas) if needless else moved.deltas
    # Deltas of halves add up to those of their whole.
    named = torch.einsum("nm,mvc->nvc", (translation > 0).to(predicted), predicted)
    named = (named * _shares_of_the_whole(transferred, split)).to(transferred)
    deltas = torch.where(predictable[:, None, None], named, transferred)
    return BlendshapeRig(neutral, deltas, template.names, moved.correctives)


def _shares_of_the_whole(transferred: Tensor, split: Tensor) -> Tensor:
    """What part of a predicted whole each shape moves at each vertex, (N,V,1): as the transferred halves divide it.

    Args:
        transferred: (N,V,3), millimetres.
        split: where a shape is a half of a predicted one, (N,M) bool.
    """
    size = transferred.norm(dim=-1)
    shares = torch.ones_like(size)
    for column in split.any(0).nonzero()[:, 0]:  # one or two shapes of a rig are split
        rows = split[:, column].nonzero()[:, 0]
        shares[rows] = (size[rows] + _STILL) / (size[rows] + _STILL).sum(0)
    return shares[..., None]


def _laid_together(neutrals: Tensor) -> tuple[Tensor, Similarity]:
    """Neutrals (M,V,3) on their mean, rotation and translation only, float64, and what moved them there."""
    points = neutrals.double()
    mean = points[0] - points[0].mean(0)
    for _ in range(4):
        poses = similarity_transform(points, mean.expand_as(points), scale=False)
        mean = poses.apply(points).mean(0)
    return poses.apply(points), poses


def _moving(offsets: Tensor) -> Tensor:
    """Which vertices (V,) move in some expression, of offsets (M,N,V,3); all of them where none does."""
    moved = offsets.square().sum(-1).mean(0).sqrt()
    moves = (moved > _MOVES * moved.amax(1, keepdim=True)).any(0)
    return moves if bool(moves.any()) else torch.ones_like(moves)


def _components_or_mean(samples: Tensor) -> PrincipalComponents:
    """Principal components; none where all people make the same offsets."""
    if bool((samples - samples[0]).abs().max() > _STILL) if samples.numel() else False:
        return principal_components(samples)
    none = samples.new_zeros(0, samples.shape[1])
    return PrincipalComponents(samples.double().mean(0), none, none.new_zeros(0), 0.0, 0)


def _check_examples(neutrals: Tensor, expressions: Tensor, names: Sequence[str]) -> None:
    if neutrals.ndim != 3 or neutrals.shape[-1] != 3 or len(neutrals) < 2:
        raise ShapeError(f"neutrals: found {tuple(neutrals.shape)}, expected (M,V,3) of at least two people")
    wanted = (len(neutrals), len(names), *neutrals.shape[1:])
    if expressions.ndim != 4 or expressions.shape[:1] + expressions.shape[2:] != wanted[:1] + wanted[2:]:
        raise ShapeError(f"expressions: found {tuple(expressions.shape)}, expected ({wanted[0]},N,{wanted[2]},3)")
    if expressions.shape[1] != len(names):
        raise NameMismatchError(f"names: found {len(names)}, expected one for each of {expressions.shape[1]}")
    for what, tensor in (("neutrals", neutrals), ("expressions", expressions)):
        bad = int((~torch.isfinite(tensor)).flatten(1).any(1).sum())
        if bad:
            raise ValueRangeError(f"{what}: {bad} of {len(tensor)} hold NaN or infinity; expected none")
