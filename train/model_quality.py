"""Quality of a morphable model: compactness, generalisation, specificity."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.sample_batches import Samples, blocks
from torchface.optim.eigenpairs import largest_eigenpairs

_MAX_LEFT_OUT = 400


@dataclass(frozen=True, eq=False)
class ModelQuality:
    """The three measures for models of 1 to K components; errors are root mean squares over the vertices."""

    components: Tensor  # how many, (J,) int64
    compactness: Tensor  # share of the variance they hold, (J,)
    generalisation: Tensor  # how far a sample lies from the model of all the others, the mean over the samples, (J,)
    generalisation_error: Tensor  # standard error of that mean, (J,)
    specificity: Tensor  # how far random samples of the model lie from the nearest training sample, the mean, (J,)
    nearest: float  # how far training samples lie from the nearest other one, the mean: beside it stands specificity


def model_quality(
    samples: Samples, components: Sequence[int], drawn: int = 500, generator: torch.Generator | None = None
) -> ModelQuality:
    r"""Compactness, generalisation by leaving one out, and specificity, all from the Gram matrix of the samples.

    Leaving sample i out, the others' components come from their own part of the matrix, and so do the inner products
    of i with them: no model is made of vertices. A random sample of K components lies from training sample j by
    :math:`\sqrt{\sum_k (a_k \sigma_k - b_{jk})^2}` with b its coordinates along all components.

    Args:
        samples: (M,V,C), aligned; of more than 400, 400 at even steps are left out, one at a time.
        components: how many components to measure with, each from 1 to M-2.
        drawn: how many random samples.
        generator: draws them; seeded with 0 if absent.

    Source: Styner et al. 2003 (the three measures); thesis 3.2.4.

    Example:
        >>> from torchface.io import MeshSequence, MeshSequenceWriter
        >>> with MeshSequenceWriter("heads.safetensors", 12, 40, torch.tensor([[0, 1, 2]])) as writer:
        ...     writer.append(torch.randn(12, 40, 3, generator=torch.Generator().manual_seed(0)))
        >>> quality = model_quality(MeshSequence("heads.safetensors"), [1, 5, 10], drawn=50)
        >>> bool((quality.compactness.diff() > 0).all())
        True
    """
    count, vertices, _ = samples.shape
    numbers = torch.as_tensor(list(components), dtype=torch.int64)
    if count < 3 or not len(numbers) or not 1 <= int(numbers.min()) <= int(numbers.max()) <= count - 2:
        raise ShapeError(
            f"model quality: found {count} samples and components {list(components)[:5]}, expected at least three "
            "samples and from 1 component to two fewer than samples"
        )
    gram = _centred_gram(samples)
    values, vectors = largest_eigenpairs(gram)
    values = values.clamp(min=0)
    along = vectors * values.sqrt()  # training samples along all components, (M,M)
    left = torch.linspace(0, count - 1, min(count, _MAX_LEFT_OUT)).round().long()
    missed = torch.stack([_left_out(gram, int(i), numbers) for i in left]) / vertices
    errors = missed.clamp(min=0).sqrt()
    deviations = (values / (count - 1)).sqrt()
    generator = generator or torch.Generator().manual_seed(0)
    random = torch.randn(drawn, count, generator=generator, dtype=torch.float64) * deviations
    apart = torch.cdist(along, along).fill_diagonal_(torch.inf).amin(1)
    specific = []
    for number in numbers.tolist():
        cut = random.clone()
        cut[:, number:] = 0
        specific.append(torch.cdist(cut, along).amin(1).mean() / vertices**0.5)
    return ModelQuality(
        numbers,
        values.cumsum(0)[numbers - 1] / values.sum(),
        errors.mean(0),
        errors.std(0) / len(errors) ** 0.5,
        torch.stack(specific),
        float(apart.mean() / vertices**0.5),
    )


def _centred_gram(samples: Samples) -> Tensor:
    """(M,M) float64."""
    parts = list(blocks(samples))
    mean = sum(samples.read(*part).sum(0, dtype=torch.float64) for part in parts) / samples.shape[0]
    gram = torch.empty(samples.shape[0], samples.shape[0], dtype=torch.float64)
    for number, (begin, end) in enumerate(parts):
        own = (samples.read(begin, end).double() - mean).flatten(1)
        for first, last in parts[: number + 1]:
            other = own if first == begin else (samples.read(first, last).double() - mean).flatten(1)
            product = own @ other.T
            gram[begin:end, first:last], gram[first:last, begin:end] = product, product.T
    return gram


def _left_out(gram: Tensor, index: int, numbers: Tensor) -> Tensor:
    """Squared distance (J,) of a sample from the models that the others make."""
    others = torch.arange(len(gram)) != index
    own, cross = gram[others][:, others], gram[others, index]
    means = own.mean(1)
    values, vectors = largest_eigenpairs(own - means[:, None] - means[None] + means.mean())
    toward = vectors.T @ (cross - cross.mean() - means + means.mean())
    there = values > 1e-12 * values[0]
    along = torch.where(there, toward.square() / values.clamp(min=1e-300), 0.0)
    whole = gram[index, index] - 2 * cross.mean() + means.mean()
    return whole - along.cumsum(0)[numbers - 1]
