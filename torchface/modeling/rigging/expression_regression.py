"""Expressions from a neutral face alone, as learned from other people's faces and expressions."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from torchface.errors import NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.sample_batches import Samples
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.number_checks import LARGEST_WEIGHT, as_real, checked_count, checked_number
from torchface.optim.full_precision import full_precision
from torchface.progress import Progress

Form = Literal["offsets", "expressions"]

STILL = 1e-4  # millimetres; what rounding of positions to float32 leaves of a vertex that does not move
NEUTRAL_COMPONENTS, OFFSET_COMPONENTS = 14, 13


@dataclass(frozen=True)
class ExpressionSettings:
    """How many components each expression has, how strongly they are held down, and what is predicted.

    Args:
        neutral_components, offset_components: how many, as many as the data hold where these are fewer; None
            has them chosen for each expression by leaving out one person after the other.
        ridge: as a share of the neutrals' mean variance a component; None has it chosen alike.
        form: "offsets" (equation 32) or "expressions" (equation 31).

    Raises:
        ValueRangeError: no component, or a negative ridge.

    Example:
        >>> ExpressionSettings(neutral_components=None).offset_components
        13
    """

    neutral_components: int | None = NEUTRAL_COMPONENTS
    offset_components: int | None = OFFSET_COMPONENTS
    ridge: float | None = 0.0
    form: Form = "offsets"

    def __post_init__(self) -> None:
        for what in ("neutral_components", "offset_components"):
            if getattr(self, what) is not None:
                checked_count(what, getattr(self, what), 1)
        if self.ridge is not None:
            checked_number("ridge", self.ridge, most=LARGEST_WEIGHT)
        if self.form not in get_args(Form):
            raise ValueRangeError(f"form: found {self.form!r}, expected one of {', '.join(get_args(Form))}")


class ExpressionRegression(nn.Module):
    r"""Predicts a person's expressions from the form of the neutral face.

    .. math:: X = (N - \bar N) \, N_{PCA}, \quad Y = X B, \quad \Delta = \bar\Delta + Y \, \Delta_{PCA}^\top

    with B of least squares, for each expression by itself. What is predicted are offsets :math:`\Delta = S - N` (the
    form "offsets"); in the form "expressions" it is S itself, as the thesis tries first: there the identity that 13
    components cannot hold leaks away, and it is here for comparison.

    A neutral face may have any pose: it is aligned with the mean neutral first, rotation and translation only, and
    what is predicted is rotated back. Vertices that no example moves are not stored and stay exactly where they are.

    The thesis maps one expression, the smile, from components of the whole face. Here N is the part of the face that
    moves in the expression: components of the whole face, or of what moves in any expression, hold mostly the jaw and
    the cheeks and too little of the lids.

    Args:
        vertices: V.
        names: of the N expressions.
        region: on how many of the vertices each expression depends; one number of models of older versions, which have
            one set of components for all expressions.
        moving: how many of the vertices each expression moves; or how many of the N·V places, alike.
        neutral_components, offset_components: of the two bases, the most that an expression has; rows are 0 where it
            has fewer.
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
    deviations: Tensor | None
    errors: Tensor | None

    def __init__(
        self,
        vertices: int,
        names: Sequence[str],
        region: Sequence[int] | int,
        moving: Sequence[int] | int,
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
        self.sizes = tuple((sizes,) if isinstance(sizes, int) else tuple(sizes) for sizes in (region, moving))
        stacked = () if isinstance(region, int) else (len(names),)
        for what, sizes in zip(("region", "moving"), self.sizes, strict=True):
            if len(sizes) != math.prod(stacked) or min(sizes) < 0:
                raise ShapeError(f"{what}: found {sizes!r:.80}, expected a number for each of {len(names)} expressions")
        self.topology, self.form = topology, form
        self.register_buffer("neutral_mean", torch.zeros(vertices, 3))
        self.register_buffer("region", torch.zeros(sum(self.sizes[0]), dtype=torch.int64))
        self.register_buffer("neutral_components", torch.zeros(neutral_components, sum(self.sizes[0]), 3))
        self.register_buffer("offset_mean", torch.zeros(sum(self.sizes[1]), 3))
        self.register_buffer("offset_components", torch.zeros(offset_components, sum(self.sizes[1]), 3))
        self.register_buffer("coefficients", torch.zeros(*stacked, neutral_components, offset_components))
        self.register_buffer("places", torch.zeros(sum(self.sizes[1]), dtype=torch.int64))
        self.register_buffer("deviations", None)
        self.register_buffer("errors", None)

    def add_errors(self) -> None:
        """Gives it the buffers of what it knows of itself, which models saved before there were any lack.

        ``deviations`` (N,K+1): of people along each expression's components and, last, of what none of them holds,
        millimetres; 0 where there is no such component.
        ``errors`` (2,N): of regression, over 1 + d², and of transfer for people left out, mm², summed over the
        vertices; 0 where nobody has compared.
        """
        self.deviations = self.neutral_mean.new_zeros(*self.coefficients.shape[:-2], len(self.neutral_components) + 1)
        self.errors = self.neutral_mean.new_zeros(2, len(self.names))

    @classmethod
    def fit(
        cls,
        neutrals: Tensor | Samples,
        expressions: Tensor | Samples,
        settings: ExpressionSettings = ExpressionSettings(),
        names: Sequence[str] | None = None,
        topology: str | None = None,
        region: Tensor | None = None,
        progress: Progress | None = None,
    ) -> "ExpressionRegression":
        """Learns from people in correspondence, each with a neutral face and the same expressions.

        People may be read in blocks. Passes over them: four align the neutrals with each other, one finds what moves,
        and one reads that into memory. Where it takes more than 256 MiB there are several passes an expression instead,
        and memory does not grow with the number of people but by a pose each. Numbers of components and a ridge that
        are to be chosen are chosen from 300 people, evenly spread, where there are more.

        Args:
            neutrals: (M,V,3), millimetres, in any pose.
            expressions: (M,N,V,3), each person's in the space of his or her own neutral; read in blocks, (M,N·V,3), a
                person's expressions one after the other.
            settings: how many components, and what they predict.
            names: of the expressions; ``expression0``, ... if absent.
            topology: ``Mesh.fingerprint()`` of the faces.
            region: mask (V,) of the vertices to learn from; those that move by a twentieth as far as the one that moves
                most in the expression, if absent; all of them for the form "expressions", as in the thesis.
            progress: called with each step and how far it is.

        Raises:
            ShapeError: the shapes do not fit, or there are fewer people than it takes to see how they differ.
            ValueRangeError: NaN or infinity, or neutrals that are all the same.
            NameMismatchError: not one name an expression, or one twice.

        Example:
            >>> generator = torch.Generator().manual_seed(0)
            >>> faces = 50 * torch.randn(1, 40, 3, generator=generator) + torch.randn(8, 40, 3, generator=generator)
            >>> smiles = faces[:, None] + torch.tensor([0.0, 5.0, 0.0])  # everybody's goes up by as much
            >>> regression = ExpressionRegression.fit(faces, smiles, names=["smile"])
            >>> bool((regression(faces[:1]) - smiles[:1]).abs().max() < 0.1)
            True
        """
        from torchface.modeling.rigging.expression_training import fit_expressions

        return fit_expressions(neutrals, expressions, settings, names, topology, region, progress)

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor needs: plain values only."""
        region, moving = (list(sizes) if self.coefficients.ndim == 3 else sizes[0] for sizes in self.sizes)
        return {
            "vertices": len(self.neutral_mean),
            "names": list(self.names),
            "region": region,
            "moving": moving,
            "neutral_components": len(self.neutral_components),
            "offset_components": len(self.offset_components),
            "topology": self.topology,
            "form": self.form,
            "judged": self.deviations is not None,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "ExpressionRegression":
        """A regression of zeros for the state to be loaded into."""
        model = cls(**{name: value for name, value in config.items() if name != "judged"})
        if config.get("judged"):
            model.add_errors()
        return model

    def forward(self, neutrals: Tensor) -> Tensor:
        """Expressions (B,N,V,3) of neutral faces (B,V,3), millimetres, in their own poses.

        Raises:
            ShapeError: the neutrals are not (B,V,3).
        """
        return self.offsets(neutrals) + as_real(neutrals, "neutrals")[:, None]

    @full_precision
    def offsets(self, neutrals: Tensor) -> Tensor:
        """How far each vertex goes in each expression, (B,N,V,3); see :meth:`forward`."""
        neutrals = as_real(neutrals, "neutrals")
        pose = self._pose(neutrals)
        aligned = pose.apply(neutrals)
        bases = self.offset_components.to(aligned).split(self.sizes[1], 1)
        maps = self.coefficients.to(aligned).view(len(bases), *self.coefficients.shape[-2:])
        offsets = [
            torch.einsum("bk,kpc->bpc", part @ inner.T @ B, outer)
            for (part, inner), B, outer in zip(self._beyond(aligned), maps, bases, strict=True)
        ]
        moving = torch.cat(offsets, 1) + self.offset_mean.to(aligned)
        whole = moving.new_zeros(len(neutrals), len(self.names) * len(self.neutral_mean), 3)
        whole = whole.index_copy(1, self.places, moving).unflatten(1, (len(self.names), -1))
        if self.form == "expressions":
            whole = whole - aligned[:, None]
        return whole @ pose.rotation.to(whole)[:, None]

    @full_precision
    def distance(self, neutrals: Tensor) -> Tensor:
        r"""How far from the people learned from neutral faces (B,V,3) are, (B,); NaN where the model is not judged.

        .. math:: d^2 = \frac1K \sum_k \frac{X_k^2}{\sigma_k^2}
            + \frac{\lVert (N - \bar N) - X N_{PCA}^\top \rVert^2}{\sigma_{rest}^2}

        averaged over the expressions. Among those learned from the first part is 1 on average, and so is the second.
        """
        neutrals = as_real(neutrals, "neutrals")
        if self.deviations is None:
            return neutrals.new_full((len(neutrals),), torch.nan)
        deviations, squared = torch.atleast_2d(self.deviations).to(neutrals), neutrals.new_zeros(len(neutrals))
        parts = self._beyond(self._pose(neutrals).apply(neutrals))
        for (part, basis), along in zip(parts, deviations, strict=True):
            X = part @ basis.T
            apart = torch.cat([X.square(), (part - X @ basis).square().sum(1, keepdim=True)], 1)
            apart = torch.where(along > 0, apart / along.square(), 0.0)
            squared = squared + apart[:, :-1].sum(1) / (along[:-1] > 0).sum().clamp(min=1) + apart[:, -1]
        return (squared / len(deviations)).sqrt()

    def _pose(self, neutrals: Tensor) -> Similarity:
        if neutrals.ndim != 3 or neutrals.shape[1:] != self.neutral_mean.shape:
            raise ShapeError(f"neutrals: found {tuple(neutrals.shape)}, expected (B,{len(self.neutral_mean)},3)")
        return similarity_transform(neutrals, self.neutral_mean.to(neutrals).expand_as(neutrals), scale=False)

    def _beyond(self, aligned: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """For each expression how its region differs from the mean's, (B,3R), and the components of that, (K,3R)."""
        beyond = (aligned - self.neutral_mean.to(aligned))[:, self.region]
        both = (values.split(self.sizes[0], 1) for values in (beyond, self.neutral_components.to(beyond)))
        for part, components in zip(*both, strict=True):
            yield part.flatten(1), components.flatten(1)

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
