"""Training of an expression regression, in passes over people who are read a few at a time."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.sample_batches import Samples, SamplesInMemory, blocks
from torchface.modeling.morphable.principal_components import PrincipalComponents, principal_components
from torchface.modeling.rigging.expression_regression import STILL, ExpressionRegression, ExpressionSettings, Form
from torchface.modeling.rigging.people_together import Aligned, Predicted, Rows, align_neutrals
from torchface.number_checks import as_tensor, checked_type
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.progress import Progress, silent

_CHOSEN_FROM = 300
"""People from whom components and ridge are chosen at most; their Gram matrices are decomposed once a person."""
# Of the vertex that moves most. The form of ears and neck predicts little of a smile, and would fill the components.
_MOVES = 0.05
_HELD_BYTES = 2**28  # parts of people that together take no more are read once, not in each pass
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
    progress("aligning the neutrals")
    mean, poses = align_neutrals(neutrals)
    predicted = Predicted(neutrals, expressions, poses, settings.form)
    progress("finding what moves")
    squared, places = _motion(predicted, len(names))
    considered = _considered(squared, region, settings.form)
    ids = considered.nonzero()[:, 1]
    sizes = considered.sum(1).tolist(), torch.bincount(places // len(mean), minlength=len(names)).tolist()
    inputs, outputs = _parts(Aligned(neutrals, poses), ids, sizes[0]), _parts(predicted, places, sizes[1])
    learned = []
    for number, parts in enumerate(zip(inputs, outputs, strict=True)):
        learned.append(_learned(*parts, settings))
        progress("learning expressions", number + 1, len(names))
    counts = max(len(one.neutral.components) for one in learned), max(len(one.offset.components) for one in learned)
    if counts[0] == 0:
        raise ValueRangeError(
            f"neutrals: found {neutrals.shape[0]} that are all the same where they move, expected some that differ"
        )
    model = ExpressionRegression(len(mean), names, *sizes, *counts, topology, settings.form)
    model.add_errors()
    assert model.deviations is not None
    for name, value in (("neutral_mean", mean), ("region", ids), ("places", places)):
        getattr(model, name).copy_(value)
    model.offset_mean.copy_(torch.cat([one.offset.mean for one in learned]).view(-1, 3))
    inner, outer = model.neutral_components.split(sizes[0], 1), model.offset_components.split(sizes[1], 1)
    for number, one in enumerate(learned):
        K, J = one.coefficients.shape
        inner[number][:K] = one.neutral.components.view(K, sizes[0][number], 3)
        outer[number][:J] = one.offset.components.view(J, sizes[1][number], 3)
        model.coefficients[number, :K, :J] = one.coefficients
        kept, total = one.neutral.standard_deviations, one.neutral.total_variance
        model.deviations[number, :K] = kept
        model.deviations[number, -1] = max(total - float(kept.square().sum()), _LEAST_LEFT * total) ** 0.5
    return model


@dataclass(frozen=True, eq=False)
class _Learned:
    """What is learned of one expression."""

    neutral: PrincipalComponents  # of its region
    offset: PrincipalComponents  # of the vertices that it moves
    coefficients: Tensor  # (K,J)


def _learned(inputs: Samples, outputs: Samples, settings: ExpressionSettings) -> _Learned:
    """Of its part of the neutrals (M,R,3) and what is to be predicted (M,P,3)."""
    inner, outer, ridge = settings.neutral_components, settings.offset_components, settings.ridge
    if outputs.shape[1] and (inner is None or outer is None or ridge is None):
        choice = choose_components(_some(inputs).flatten(1), _some(outputs).flatten(1), inner, outer, ridge)
        inner, outer, ridge = choice.inputs, choice.outputs, choice.ridge
    neutral, offset = _components_or_mean(inputs, inner), _components_or_mean(outputs, outer)
    counts = len(neutral.components), len(offset.components)
    gram, product = torch.zeros(counts[0], counts[0]).double(), torch.zeros(counts).double()
    for begin, end in blocks(max(inputs, outputs, key=lambda samples: samples.shape[1])):
        X = (inputs.read(begin, end).flatten(1) - neutral.mean) @ neutral.components.double().T
        gram += X.T @ X
        product += X.T @ ((outputs.read(begin, end).flatten(1) - offset.mean) @ offset.components.double().T)
    gram.diagonal().add_((ridge or 0.0) * gram.diagonal().mean())
    return _Learned(neutral, offset, torch.linalg.solve(gram, product))


def _parts(samples: Samples, rows: Tensor, sizes: list[int]) -> list[Rows]:
    """The rows (ΣR,) of samples (M,V,3) as those of each expression, (M,R,3); read once if they are few."""
    if 12 * samples.shape[0] * len(rows) <= _HELD_BYTES:
        samples = SamplesInMemory(Rows(samples, rows).read(0, samples.shape[0]))
        rows = torch.arange(len(rows))
    return [Rows(samples, part) for part in rows.split(sizes)]


def _motion(predicted: Predicted, expressions: int) -> tuple[Tensor, Tensor]:
    """Mean of the squared offset of each vertex in each expression, (N,V); rows of the N·V that anyone moves, (P,)."""
    count, size, _ = predicted.shape
    furthest, squared = torch.zeros(2, size, dtype=torch.float64)
    for begin, end in blocks(predicted):
        part = predicted.read(begin, end)
        if not bool(torch.isfinite(part.sum())):
            bad = (~torch.isfinite(part)).flatten(1).any(1).nonzero()[:, 0] + begin
            raise ValueRangeError(f"expressions: number {int(bad[0])} holds NaN or infinity; expected none")
        squared += part.square().sum((0, -1))
        torch.maximum(furthest, part.abs().amax((0, -1)), out=furthest)
    places = (furthest > STILL).nonzero()[:, 0] if predicted.form == "offsets" else torch.arange(size)
    return (squared / count).unflatten(0, (expressions, -1)), places


def _considered(squared: Tensor, region: Tensor | None, form: Form) -> Tensor:
    """Masks (N,V) of the vertices to learn from: the region's, or those that move in an expression, all where none
    does."""
    if region is None:
        moved = squared.sqrt()
        masks = moved > _MOVES * moved.amax(1, keepdim=True)
        return masks | (~masks.any(1, keepdim=True) if form == "offsets" else True)
    if region.dtype != torch.bool or region.shape != squared.shape[1:] or not bool(region.any()):
        raise ShapeError(f"region: found {region.dtype} {tuple(region.shape)}, expected a mask (V,), not empty")
    return region.expand(squared.shape)


def _components_or_mean(samples: Samples, most: int | None) -> PrincipalComponents:
    """Principal components; none where people do not differ."""
    count, places, _ = samples.shape
    first = samples.read(0, 1)
    total = torch.zeros(places * 3, dtype=torch.float64)
    differs = False
    for begin, end in blocks(samples):
        part = samples.read(begin, end)
        differs = differs or bool(((part - first).abs() > STILL).any())
        total += part.flatten(1).sum(0, dtype=torch.float64)
    if differs:
        return principal_components(samples, most)
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
