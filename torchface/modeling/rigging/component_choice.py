"""Choice of a regression's numbers of components, by cross-validation in sample space."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.optim.eigenpairs import largest_eigenpairs

RIDGES = (0.0, 1e-3, 1e-2, 1e-1)
_NO_VARIANCE = 1e-10


@dataclass(frozen=True)
class Choice:
    """The least error found, and where.

    Args:
        inputs: components of the input.
        outputs: components of the output.
        ridge: see ``ExpressionRegression.fit``.
        error: squared, summed over the samples left out, in the unit of the outputs.
    """

    inputs: int
    outputs: int
    ridge: float
    error: float


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
    rows = slice(None) if input_components is None else slice(min(input_components, most) - 1, None)
    columns = slice(1, None) if output_components is None else slice(min(output_components, most), None)
    allowed[:, rows, columns] = True
    if input_components is not None:
        allowed[:, min(input_components, most) :] = False
    if output_components is not None:
        allowed[:, :, min(output_components, most) + 1 :] = False
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
