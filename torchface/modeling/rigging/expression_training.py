"""How an expression regression learns: in passes over people, who are read a few at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.sample_batches import Samples, SamplesInMemory, blocks
from torchface.modeling.morphable.principal_components import PrincipalComponents
from torchface.modeling.morphable.streamed_training import sequence_components
from torchface.modeling.rigging.component_choice import choose_components
from torchface.modeling.rigging.expression_regression import STILL, ExpressionRegression, Form
from torchface.modeling.rigging.people_together import MovingPlaces, NeutralRegion, Predicted, laid_together
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number
from torchface.progress import Progress, silent

NEUTRAL_COMPONENTS, OFFSET_COMPONENTS = 14, 13
_CHOSEN_FROM = 300
"""People from whom components and ridge are chosen at most; their Gram matrices are decomposed once a person."""
# Of the vertex that moves most. The form of ears and neck predicts little of a smile, and would fill the components.
_MOVES = 0.05


@dataclass(frozen=True)
class ExpressionSettings:
    """How many components an expression regression has, how strongly they are held down, and what it predicts.

    Args:
        neutral_components, offset_components: how many, as many as the data hold where these are fewer; None
            has them chosen by leaving out one person after the other.
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


def fit_expressions(
    neutrals: Tensor,
    expressions: Tensor,
    settings: ExpressionSettings = ExpressionSettings(),
    names: Sequence[str] | None = None,
    topology: str | None = None,
    region: Tensor | None = None,
) -> ExpressionRegression:
    """Learns from people in correspondence, each with a neutral face and the same expressions.

    Args:
        neutrals: (M,V,3), millimetres, in any pose.
        expressions: (M,N,V,3), each person's in the space of his or her own neutral.
        settings: how many components, and what they predict.
        names: of the expressions; ``expression0``, ... if absent.
        topology: ``Mesh.fingerprint()`` of the faces.
        region: mask (V,) of the vertices to learn from; those that move by a twentieth as far as the one that moves
            most in some expression, if absent; all of them for the form "expressions", as in the thesis.

    Raises:
        ShapeError: the shapes do not fit, or there are fewer people than it takes to see how they differ.
        ValueRangeError: NaN or infinity, or neutrals that are all the same.
        NameMismatchError: not one name an expression, or one twice.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> faces = 50 * torch.randn(1, 40, 3, generator=generator) + torch.randn(8, 40, 3, generator=generator)
        >>> smiles = faces[:, None] + torch.tensor([0.0, 5.0, 0.0])  # everybody's goes up by as much
        >>> regression = fit_expressions(faces, smiles, names=["smile"])
        >>> bool((regression(faces[:1]) - smiles[:1]).abs().max() < 0.1)
        True
    """
    names = [f"expression{i}" for i in range(expressions.shape[1])] if names is None else list(names)
    _check_examples(neutrals, expressions, names)
    samples = SamplesInMemory(neutrals), SamplesInMemory(expressions.flatten(1, 2))
    return fit_expression_samples(*samples, names, settings, topology, region)


def fit_expression_samples(
    neutrals: Samples,
    expressions: Samples,
    names: Sequence[str],
    settings: ExpressionSettings = ExpressionSettings(),
    topology: str | None = None,
    region: Tensor | None = None,
    progress: Progress | None = None,
) -> ExpressionRegression:
    """What :func:`fit_expressions` learns, from people who are read in blocks.

    Passes over the people: four lay the neutrals on each other, one finds what moves, two sets of principal components
    take what :func:`~torchface.modeling.morphable.streamed_training.fit_sequence` takes, and one sums up the normal
    equations. Memory does not grow with their number but by a pose each. Numbers of components and a ridge that are to
    be chosen are chosen from 300 people, evenly spread, where there are more.

    Args:
        neutrals: (M,V,3).
        expressions: (M,N·V,3), a person's expressions one after the other.
        names: of the N expressions.
        progress: called with each step and how far it is.

    All others, Raises: as :func:`fit_expressions`.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> faces = 50 * torch.randn(1, 40, 3, generator=generator) + torch.randn(8, 40, 3, generator=generator)
        >>> smiles = faces + torch.tensor([0.0, 5.0, 0.0])
        >>> in_blocks = fit_expression_samples(SamplesInMemory(faces), SamplesInMemory(smiles), ["smile"])
        >>> at_once = fit_expressions(faces, smiles[:, None], names=["smile"])
        >>> torch.allclose(in_blocks(faces), at_once(faces), atol=1e-3)
        True
    """
    progress = progress or silent
    form, ridge = settings.form, settings.ridge
    neutral_components, offset_components = settings.neutral_components, settings.offset_components
    progress("laying the neutrals on each other")
    mean, poses = laid_together(neutrals)
    predicted = Predicted(neutrals, expressions, poses, form)
    progress("finding what moves")
    motion = _motion(predicted, len(names))
    considered = _considered(motion, region, form)
    flat, moving = NeutralRegion(neutrals, poses, considered), MovingPlaces(predicted, motion.places)
    if neutral_components is None or offset_components is None or ridge is None:
        progress("choosing how many components")
        inputs, outputs = (_some(samples).flatten(1) for samples in (flat, moving))
        choice = choose_components(inputs, outputs, neutral_components, offset_components, ridge)
        neutral_components, offset_components, ridge = choice.inputs, choice.outputs, choice.ridge
    neutral = sequence_components(flat, neutral_components, progress=progress)
    offset = _components_or_mean(moving, motion, offset_components, progress)
    kept = len(neutral.components), len(offset.components)
    model = ExpressionRegression(len(mean), names, len(considered), len(motion.places), *kept, topology, form)
    model.neutral_mean.copy_(mean)
    model.region.copy_(considered)
    model.neutral_components.copy_(neutral.components.unflatten(1, (-1, 3)))
    model.offset_mean.copy_(offset.mean.view(-1, 3))
    model.offset_components.copy_(offset.components.reshape(kept[1], len(motion.places), 3))
    progress("solving for the coefficients")
    gram, product = torch.zeros(kept[0], kept[0]).double(), torch.zeros(kept).double()
    for begin, end in blocks(expressions):
        X = flat.read(begin, end).flatten(1).double().sub_(neutral.mean)
        Y = moving.read(begin, end).flatten(1).double().sub_(offset.mean)
        X = X @ model.neutral_components.flatten(1).double().T
        gram += X.T @ X
        product += X.T @ (Y @ model.offset_components.flatten(1).double().T)
    gram.diagonal().add_(ridge * gram.diagonal().mean())
    model.coefficients.copy_(torch.linalg.solve(gram, product))
    model.places.copy_(motion.places)
    return model


@dataclass(frozen=True, eq=False)
class _Motion:
    """How far people move.

    Args:
        squared: mean of the squared offset of each vertex in each expression, (N,V).
        places: rows of the N·V that anyone moves, (P,).
        differs: whether people move these differently.
    """

    squared: Tensor
    places: Tensor
    differs: bool


def _motion(predicted: Predicted, expressions: int) -> _Motion:
    count, size, _ = predicted.shape
    first = predicted.read(0, 1)[0]
    furthest, apart = torch.zeros_like(first), torch.zeros_like(first)
    squared = torch.zeros(size, dtype=torch.float64)
    for begin, end in blocks(predicted):
        part = predicted.read(begin, end)
        if not bool(torch.isfinite(part.sum())):
            bad = (~torch.isfinite(part)).flatten(1).any(1).nonzero()[:, 0] + begin
            raise ValueRangeError(f"expressions: number {int(bad[0])} holds NaN or infinity; expected none")
        squared += part.square().sum((0, -1))
        torch.maximum(furthest, part.abs().amax(0), out=furthest)
        torch.maximum(apart, part.sub_(first).abs_().amax(0), out=apart)
    places = (furthest.amax(-1) > STILL).nonzero()[:, 0] if predicted.form == "offsets" else torch.arange(size)
    differs = bool((apart[places] > STILL).any())
    return _Motion((squared / count).unflatten(0, (expressions, -1)), places, differs)


def _considered(motion: _Motion, region: Tensor | None, form: Form) -> Tensor:
    """Rows of the vertices to learn from: the region's, or those that move in some expression, all where none does."""
    vertices = motion.squared.shape[1]
    if region is None:
        moved = motion.squared.sqrt()
        region = (moved > _MOVES * moved.amax(1, keepdim=True)).any(0)
        if form == "expressions" or not bool(region.any()):
            region = torch.ones(vertices, dtype=torch.bool)
    if region.dtype != torch.bool or region.shape != (vertices,) or not bool(region.any()):
        raise ShapeError(f"region: found {region.dtype} {tuple(region.shape)}, expected a mask (V,), not empty")
    return region.nonzero()[:, 0]


def _components_or_mean(moving: MovingPlaces, motion: _Motion, most: int, progress: Progress) -> PrincipalComponents:
    """Principal components; none where all people make the same offsets."""
    if motion.differs:
        return sequence_components(moving, most, progress=progress)
    count, places, _ = moving.shape
    total = torch.zeros(places * 3, dtype=torch.float64)
    for begin, end in blocks(moving) if places else ():
        total += moving.read(begin, end).flatten(1).sum(0, dtype=torch.float64)
    none = torch.zeros(0, places * 3, dtype=torch.float64)
    return PrincipalComponents(total / count, none, none.new_zeros(0), 0.0, 0)


def _some(samples: Samples) -> Tensor:
    """All of the samples, or three hundred of them, evenly spread."""
    count = samples.shape[0]
    if count <= _CHOSEN_FROM:
        return torch.cat([samples.read(*block) for block in blocks(samples)])
    rows = [i * count // _CHOSEN_FROM for i in range(_CHOSEN_FROM)]
    return torch.cat([samples.read(row, row + 1) for row in rows])


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
