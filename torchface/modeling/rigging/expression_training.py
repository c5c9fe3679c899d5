"""Training of an expression regression, in passes over people who are read a few at a time."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.sample_batches import Samples, SamplesInMemory, blocks
from torchface.modeling.morphable.principal_components import PrincipalComponents, principal_components
from torchface.modeling.rigging.expression_regression import STILL, ExpressionRegression, ExpressionSettings, Form
from torchface.modeling.rigging.people_together import MovingPlaces, NeutralRegion, Predicted, align_neutrals
from torchface.number_checks import as_tensor, checked_type
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.progress import Progress, silent

_CHOSEN_FROM = 300
"""People from whom components and ridge are chosen at most; their Gram matrices are decomposed once a person."""
# Of the vertex that moves most. The form of ears and neck predicts little of a smile, and would fill the components.
_MOVES = 0.05
_LEAST_LEFT = 0.01  # of the variance, beyond the components: few people fit in them whole, another one does not


def fit_expressions(
    neutrals: Tensor | Samples,
    expressions: Tensor | Samples,
    settings: ExpressionSettings,
    names: Sequence[str] | None,
    topology: str | None,
    region: Tensor | None,
    progress: Progress | None,
) -> ExpressionRegression:
    """The regression of :meth:`ExpressionRegression.fit`, which says what the arguments are."""
    checked_type("settings", settings, ExpressionSettings)
    neutrals, expressions, names = _people(neutrals, expressions, names)
    progress = progress or silent
    form, ridge = settings.form, settings.ridge
    neutral_components, offset_components = settings.neutral_components, settings.offset_components
    progress("aligning the neutrals")
    mean, poses = align_neutrals(neutrals)
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
    neutral = principal_components(flat, neutral_components, progress=progress)
    offset = _components_or_mean(moving, motion, offset_components, progress)
    counts = len(neutral.components), len(offset.components)
    model = ExpressionRegression(len(mean), names, len(considered), len(motion.places), *counts, topology, form)
    model.add_errors()
    model.neutral_mean.copy_(mean)
    model.region.copy_(considered)
    model.neutral_components.copy_(neutral.components.unflatten(1, (-1, 3)))
    model.offset_mean.copy_(offset.mean.view(-1, 3))
    model.offset_components.copy_(offset.components.reshape(counts[1], len(motion.places), 3))
    progress("solving for the coefficients")
    gram, product = torch.zeros(counts[0], counts[0]).double(), torch.zeros(counts).double()
    for begin, end in blocks(expressions):
        X = flat.read(begin, end).flatten(1) - neutral.mean
        Y = moving.read(begin, end).flatten(1) - offset.mean
        X = X @ model.neutral_components.flatten(1).double().T
        gram += X.T @ X
        product += X.T @ (Y @ model.offset_components.flatten(1).double().T)
    gram.diagonal().add_(ridge * gram.diagonal().mean())
    model.coefficients.copy_(torch.linalg.solve(gram, product))
    model.places.copy_(motion.places)
    kept = neutral.standard_deviations.square()
    left = max(neutral.total_variance - float(kept.sum()), _LEAST_LEFT * neutral.total_variance)
    assert model.deviations is not None
    model.deviations.copy_(torch.cat([kept, kept.new_tensor([left])]).sqrt())
    return model


@dataclass(frozen=True, eq=False)
class _Motion:
    """How far people move."""

    squared: Tensor  # mean of the squared offset of each vertex in each expression, (N,V)
    places: Tensor  # rows of the N·V that anyone moves, (P,)
    differs: bool  # whether people move these differently


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
        return principal_components(moving, most, progress=progress)
    count, places, _ = moving.shape
    total = torch.zeros(places * 3, dtype=torch.float64)
    for begin, end in blocks(moving) if places else ():
        total += moving.read(begin, end).flatten(1).sum(0, dtype=torch.float64)
    none = torch.zeros(0, places * 3, dtype=torch.float64)
    return PrincipalComponents(total / count, none, none.new_zeros(0), 0.0)


def _some(samples: Samples) -> Tensor:
    """All of the samples, or three hundred of them, evenly spread."""
    count = samples.shape[0]
    if count <= _CHOSEN_FROM:
        return torch.cat([samples.read(*block) for block in blocks(samples)])
    rows = [i * count // _CHOSEN_FROM for i in range(_CHOSEN_FROM)]
    return torch.cat([samples.read(row, row + 1) for row in rows])


def _people(
    neutrals: Tensor | Samples, expressions: Tensor | Samples, names: Sequence[str] | None
) -> tuple[Samples, Samples, list[str]]:
    """People as samples (M,V,3) and (M,N·V,3), and the names of the N expressions; refuses what does not fit."""
    if not hasattr(neutrals, "read"):
        neutrals = SamplesInMemory(as_tensor("neutrals", neutrals, "(M,V,3)").detach())
    if len(neutrals.shape) != 3 or neutrals.shape[2] != 3 or neutrals.shape[0] < 2:
        raise ShapeError(f"neutrals: found {tuple(neutrals.shape)}, expected (M,V,3) of at least two people")
    count, vertices, _ = neutrals.shape
    if not hasattr(expressions, "read"):
        expressions = as_tensor("expressions", expressions, "(M,N,V,3)").detach()
        found = tuple(expressions.shape)
        if found[:1] + found[2:] != (count, vertices, 3) or 0 in found:
            raise ShapeError(f"expressions: found {found}, expected ({count},N,{vertices},3)")
        expressions = SamplesInMemory(expressions.flatten(1, 2))
    found = tuple(expressions.shape)
    if len(found) != 3 or (found[0], found[1] % vertices, found[2]) != (count, 0, 3):
        raise ShapeError(f"expressions: found {found}, expected ({count},N·{vertices},3)")
    shown = expressions.shape[1] // vertices
    names = [f"expression{i}" for i in range(shown)] if names is None else list(names)
    if len(names) != shown:
        raise NameMismatchError(f"names: found {len(names)}, expected one for each of {shown}")
    return neutrals, expressions, names


RIDGES = (0.0, 1e-3, 1e-2, 1e-1)
_NO_VARIANCE = 1e-10


@dataclass(frozen=True)
class Choice:
    """The least error found, and where."""

    inputs: int  # components of the input
    outputs: int  # components of the output
    ridge: float  # see `ExpressionRegression.fit`
    error: float  # squared, summed over the samples left out, in the unit of the outputs


def choose_components(
    inputs: Tensor,
    outputs: Tensor,
    input_components: int | None = None,
    output_components: int | None = None,
    ridge: float | None = None,
) -> Choice:
    r"""Leaves out one sample after the other and predicts it from the rest with every number of components.

    A prediction is a combination of the samples learned from, :math:`\hat y = \sum_i c_i y_i`, so that inner products
    of the samples are all that is needed:

    .. math:: \lVert \hat y - y \rVert^2 = (c, -1) \, G_Y \, (c, -1)^\top

    Args:
        inputs: (M,D).
        outputs: (M,E).
        input_components, output_components, ridge: what is not to be chosen; numbers above what the data hold count
            as all of them.
    """
    if len(inputs) < 3 or len(inputs) != len(outputs):
        raise ShapeError(f"found {len(inputs)} inputs and {len(outputs)} outputs, expected as many, three at least")
    gram_in, gram_out = _gram(inputs), _gram(outputs)
    ridges = RIDGES if ridge is None else (ridge,)
    most = len(inputs) - 2
    errors = torch.zeros(len(ridges), most, most + 1, dtype=torch.float64)
    for left_out in range(len(inputs)):  # a fold each: a spectrum each
        errors += _fold_errors(gram_in, gram_out, left_out, ridges, most)
    allowed = torch.zeros_like(errors, dtype=torch.bool)
    rows = slice(None) if input_components is None else min(input_components, most) - 1
    columns = slice(1, None) if output_components is None else min(output_components, most)
    allowed[:, rows, columns] = True
    # Of equal errors the first: the smallest ridge and the smallest number of components.
    best = int(torch.where(allowed, errors, torch.inf).argmin())
    r, k, j = (int(index) for index in torch.unravel_index(torch.tensor(best), errors.shape))
    return Choice(k + 1, j, ridges[r], float(errors[r, k, j]))


def _gram(samples: Tensor) -> Tensor:
    centred = samples.double().flatten(1)
    centred = centred - centred.mean(0)
    return centred @ centred.T


def _fold_errors(gram_in: Tensor, gram_out: Tensor, left_out: int, ridges: tuple[float, ...], most: int) -> Tensor:
    """Squared errors (R,K,J+1) of one sample with k+1 input and j output components; j = 0 is the mean."""
    kept = torch.arange(len(gram_in)) != left_out
    count = int(kept.sum())
    centre = torch.eye(count, dtype=torch.float64) - 1 / count
    values, vectors = _spectrum(centre @ gram_in[kept][:, kept] @ centre, most)
    _, directions = _spectrum(centre @ gram_out[kept][:, kept] @ centre, most)
    across = centre @ (gram_in[kept, left_out] - gram_in[kept][:, kept].mean(1))
    # Of sample i: scores sqrt(λ_k) v_ik; of the one left out: v_kᵀ g / sqrt(λ_k).
    projected = vectors.T @ across
    average = values.cumsum(0) / torch.arange(1, len(values) + 1)
    errors = torch.zeros(len(ridges), most, most + 1, dtype=torch.float64)
    inner = gram_out[kept][:, kept]
    aside = gram_out[kept, left_out]
    for r, ridge in enumerate(ridges):
        # Weight of input component k where k+1 of them are kept: (K,K), lower triangular.
        weight = (projected / (values + ridge * average[:, None])).tril()
        combined = weight @ vectors.T @ directions  # along each output direction, (K,J)
        steps = combined[:, :, None] * directions.T[None]
        combination = torch.cat([torch.zeros(len(steps), 1, count), steps.cumsum(1)], 1) + 1 / count
        error = torch.einsum("kji,il,kjl->kj", combination, inner, combination) - 2 * combination @ aside
        error = error + gram_out[left_out, left_out]
        # Where the data hold no more components, more of them change nothing.
        error = torch.cat([error, error[:, -1:].expand(-1, most + 1 - error.shape[1])], 1)
        errors[r] = torch.cat([error, error[-1:].expand(most - len(error), -1)], 0)
    return errors


def _spectrum(gram: Tensor, most: int) -> tuple[Tensor, Tensor]:
    values, vectors = largest_eigenpairs(gram, most)
    held = values > _NO_VARIANCE * values[0].clamp(min=1e-300)
    return values[held], vectors[:, held]
