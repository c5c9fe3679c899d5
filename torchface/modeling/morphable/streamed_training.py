"""A morphable model of more samples than memory holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, eigsh
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder
from torchface.geometry.sample_batches import Samples, blocks
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.morphable.principal_components import (
    PrincipalComponents,
    check_count,
    check_rank,
    gram_spectrum,
    signs,
)
from torchface.modeling.morphable.subspace_iteration import SUBSPACE, leading_components
from torchface.progress import Progress, silent

_BLOCK_BYTES = 2**27
_WHOLE_SPECTRUM = 1500
_MAX_COMPONENTS = 200
_GRAM_SAMPLES = 4000
"""Above, time and memory of the Gram matrix grow past those of passes over the samples."""
_METHOD = "gram rows/2"


def fit_sequence(
    samples: Samples,
    components: int | None = None,
    checkpoint: str | Path | None = None,
    progress: Progress | None = None,
) -> MorphableModel:
    r"""What :meth:`MorphableModel.fit` learns, from samples that are read in blocks.

    Three passes: the mean; the Gram matrix, block by block of rows, in float64; the components. Memory is taken by the
    Gram matrix (8 M² bytes) and two blocks. Its leading eigenpairs come from Lanczos' iteration, to the precision
    of float64. Of more than 4,000 samples, and components fewer than an eighth of them, no Gram matrix is made:
    subspace iteration takes memory that does not depend on M and time in proportion to it, see
    :func:`~torchface.modeling.morphable.subspace_iteration.leading_components`.

    Args:
        samples: in correspondence, aligned.
        components: how many; if absent as many as the samples differ in, but at most 200 of more than 1,500 samples.
        checkpoint: a folder for the rows of the Gram matrix, or the passes, that are finished. Killed and started
            again with the same samples in the same order and the same folder, the fit continues; rows of other samples
            and damaged ones are computed again. In the end the files are removed.
        progress: called with each step and how far it is.

    Raises:
        ShapeError: fewer than two samples.
        ValueRangeError: NaN or infinity, samples that are all the same, or more components than they hold.
        FileFormatError: the checkpoint cannot be written.

    Source: thesis 3.2.4, equation 8; Lehoucq, Sorensen, Yang 1998 (Lanczos).

    Example:
        >>> from torchface.io import MeshSequence, MeshSequenceWriter
        >>> heads = torch.randn(6, 40, 3, generator=torch.Generator().manual_seed(0)).float()
        >>> with MeshSequenceWriter("heads.safetensors", 6, 40, torch.tensor([[0, 1, 2]])) as writer:
        ...     writer.append(heads)
        >>> streamed, at_once = fit_sequence(MeshSequence("heads.safetensors"), 3), MorphableModel.fit(heads, 3)
        >>> torch.allclose(streamed.standard_deviations, at_once.standard_deviations, rtol=1e-4)
        True
    """
    count, vertices, channels = samples.shape
    check_count(count, components)
    found = sequence_components(samples, components, checkpoint, progress)
    check_rank(count, len(found.components), components)
    return MorphableModel(
        found.mean.reshape(vertices, channels),
        found.components.reshape(-1, vertices, channels),
        found.standard_deviations,
        found.total_variance,
        count,
    )


def sequence_components(
    samples: Samples,
    most: int | None = None,
    checkpoint: str | Path | None = None,
    progress: Progress | None = None,
) -> PrincipalComponents:
    """The principal components behind :func:`fit_sequence`, float64; fewer than ``most`` where there are no more.

    Args, Raises: as :func:`fit_sequence`; but more components than the samples hold may be asked for.
    """
    report, components = progress or silent, most
    count, vertices, channels = samples.shape
    check_count(count, None)
    if components is None and count > _WHOLE_SPECTRUM:
        components = _MAX_COMPONENTS
    if components is not None:
        components = min(components, count - 1)
    parts = list(blocks(samples, _BLOCK_BYTES))
    if components is not None and count > max(_GRAM_SAMPLES, 8 * components):
        return _by_passes(samples, parts, components, None if checkpoint is None else Path(checkpoint), report)
    work = 2 * len(parts) + len(parts) * (len(parts) + 1) // 2
    steps = iter(range(1, work + 1))

    def step() -> None:
        report("fitting principal components", next(steps), work)

    mean, floor, contents = _mean(samples, parts, step, keyed=checkpoint is not None)
    gram = torch.zeros(count, count, dtype=torch.float64)
    rows = _Rows(None if checkpoint is None else Path(checkpoint), content_key(_METHOD, samples=contents, parts=parts))
    for number, (begin, end) in enumerate(parts):
        if (stored := rows.read(number, end - begin, end)) is not None:
            gram[begin:end, :end] = stored
            for _ in range(number + 1):
                step()
            continue
        own = _centred(samples, begin, end, mean)
        for first, last in parts[: number + 1]:
            other = own if first == begin else _centred(samples, first, last, mean)
            gram[begin:end, first:last] = own @ other.T
            step()
        rows.write(number, gram[begin:end, :end])
    values, vectors, trace = _leading(gram, floor, components)
    toward = (vectors / values.sqrt()).T.contiguous()
    del gram, vectors
    learned = torch.zeros(len(values), vertices * channels, dtype=torch.float64)
    for begin, end in parts:
        learned.addmm_(toward[:, begin:end], _centred(samples, begin, end, mean))
        step()
    learned.mul_(signs(learned)[:, None])
    rows.remove()
    return PrincipalComponents(mean, learned, (values / (count - 1)).sqrt(), trace / (count - 1), len(values))


def _by_passes(
    samples: Samples, parts: list[tuple[int, int]], components: int, checkpoint: Path | None, report: Progress
) -> PrincipalComponents:
    count, vertices, channels = samples.shape
    mean, floor, contents = _mean(samples, parts, lambda: None, keyed=checkpoint is not None)
    if checkpoint is not None:
        make_folder(checkpoint)
    found = leading_components(
        lambda begin, end: _centred(samples, begin, end, mean),
        parts,
        vertices * channels,
        components,
        checkpoint,
        content_key(_METHOD, samples=contents, parts=parts, components=components),
        lambda done, total: report("fitting principal components", done, total),
    )
    rank = int((found.values > max(floor, 1e-12 * float(found.values.max()))).sum())
    check_rank(count, rank, None)
    values, vectors = found.values[:rank], found.vectors[:rank]
    vectors = vectors * signs(vectors)[:, None]
    if checkpoint is not None:
        (checkpoint / SUBSPACE).unlink(missing_ok=True)
        if not any(checkpoint.iterdir()):
            checkpoint.rmdir()
    return PrincipalComponents(mean, vectors, (values / (count - 1)).sqrt(), found.trace / (count - 1), rank)


def _mean(
    samples: Samples, parts: list[tuple[int, int]], step: Callable[[], None], keyed: bool
) -> tuple[Tensor, float, list[str]]:
    """The mean (D,) float64, the eigenvalue that rounding alone makes, and if asked for the key of each block."""
    total: Tensor | None = None
    largest = eps = 0.0
    contents = []
    for begin, end in parts:
        part = samples.read(begin, end).flatten(1)
        summed = part.sum(0, dtype=torch.float64)
        if not bool(torch.isfinite(summed).all()):
            bad = (~torch.isfinite(part)).any(1).nonzero()[:, 0] + begin
            raise ValueRangeError(f"samples: number {int(bad[0])} holds NaN or infinity; expected none")
        total = summed if total is None else total + summed
        largest, eps = max(largest, float(part.abs().max())), torch.finfo(part.dtype).eps
        if keyed:
            contents.append(content_key(_METHOD, block=part))
        step()
    assert total is not None
    return total / samples.shape[0], (eps * largest) ** 2 * len(total), contents


def _centred(samples: Samples, begin: int, end: int, mean: Tensor) -> Tensor:
    return samples.read(begin, end).flatten(1).double().sub_(mean)


def _leading(gram: Tensor, floor: float, count: int | None) -> tuple[Tensor, Tensor, float]:
    """The leading eigenpairs, those above rounding, of a matrix whose lower triangle is filled, and its trace."""
    size = len(gram)
    if count is None or size <= _WHOLE_SPECTRUM or count > size // 4:
        spectrum = gram_spectrum(gram, floor)
        return spectrum.values[:count], spectrum.vectors[:, :count], spectrum.trace
    trace = float(gram.diagonal().sum())
    if trace <= floor:
        check_rank(size, 0, None)
    for begin in range(0, size, 1024):  # in strips: a transpose of the whole would be a second matrix
        end = begin + 1024
        gram[begin:end, end:] = gram[end:, begin:end].T
        strip = gram[begin:end, begin:end]
        strip.copy_(strip.tril() + strip.tril(-1).T)
    apply = LinearOperator((size, size), matvec=lambda x: gram.numpy() @ x, dtype=np.float64)
    start = np.cos(np.arange(size, dtype=np.float64))
    values, vectors = eigsh(apply, count, which="LA", v0=start)
    order = np.argsort(values)[::-1]
    rank = int((values > max(floor, 1e-12 * values.max())).sum())
    check_rank(size, rank, None)
    kept = order[:rank]
    return torch.from_numpy(values[kept].copy()), torch.from_numpy(vectors[:, kept].copy()), trace


class _Rows:
    """Finished rows of the Gram matrix on disk; with another key they begin anew."""

    def __init__(self, folder: Path | None, key: str) -> None:
        self._folder, self._key = folder, key
        if folder is not None:
            make_folder(folder)

    def read(self, number: int, rows: int, columns: int) -> Tensor | None:
        """The rows if they are there and whole."""
        found = None if self._folder is None else read_checkpoint(self._path(number), self._key)
        gram = None if found is None else found.get("rows")
        if gram is None or gram.shape != (rows, columns) or gram.dtype != torch.float64:
            return None
        return gram if bool(torch.isfinite(gram).all()) else None

    def write(self, number: int, rows: Tensor) -> None:
        if self._folder is not None:
            write_checkpoint(self._path(number), {"rows": rows}, self._key)

    def remove(self) -> None:
        if self._folder is not None and self._folder.is_dir():
            for path in [*self._folder.glob("gram_*"), *self._folder.glob(".gram_*.part")]:
                path.unlink(missing_ok=True)
            if not any(self._folder.iterdir()):
                self._folder.rmdir()

    def _path(self, number: int) -> Path:
        assert self._folder is not None
        return self._folder / f"gram_{number:05}.safetensors"
