"""Principal components of samples in memory or on disk, in passes over them; a killed run continues."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder
from torchface.geometry.sample_batches import Samples, blocks
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.progress import Progress, silent

_BLOCK_BYTES = 2**27
_COLUMNS = 2048  # of a block that fit in a processor's cache, for all of its samples
_WHOLE_SPECTRUM = 1500
_MAX_COMPONENTS = 200
_GRAM_SAMPLES = 4000  # above, time and memory of the Gram matrix grow past those of passes over the samples
_NO_VARIANCE = 1e-12  # of the largest eigenvalue: what rounding leaves where there is nothing
_METHOD = "gram rows/2"
_STEP = "fitting principal components"
SUBSPACE = "subspace.safetensors"
_SEED = 0
_MAX_PASSES = 30
_SETTLED = 1e-6  # relative change of a variance from one pass to the next, below which all have settled


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """The mean of samples and the directions in which they vary, what a linear Gaussian model learns."""

    mean: Tensor  # (D,) float64
    components: Tensor  # orthonormal rows (K,D), the one that varies most first; summed in float64
    standard_deviations: Tensor  # of the samples along them, (K,) float64
    total_variance: float  # of the samples, all D dimensions summed, whether a component holds it or not


def principal_components(
    samples: Samples, most: int | None = None, checkpoint: str | Path | None = None, progress: Progress | None = None
) -> PrincipalComponents:
    r"""The directions in which samples vary most; fewer than ``most`` where there are no more.

    .. math:: G = X X^\top = V \Lambda V^\top, \quad u_k = X^\top v_k / \sqrt{\lambda_k}, \quad
        \sigma_k^2 = \lambda_k / (M - 1)

    for centred samples X (M,D) with :math:`M \ll D`. Three passes: the mean; the Gram matrix, block by block of rows,
    in float64; the components. Memory is taken by the Gram matrix (8 M² bytes), the components (8 K D bytes) and two
    blocks. Of more than 4,000 samples, and components fewer than an eighth of them, no Gram matrix is made: subspace
    iteration takes memory that does not depend on M and time in proportion to it, see
    :func:`~torchface.modeling.morphable.principal_components.leading_components`. A component points to where
    :math:`\sum_i u_i \cos i` is positive, so that the same samples in any order give the same ones.

    Args:
        samples: (M,V,C), D = V·C.
        most: how many components; if absent as many as the samples differ in, but at most 200 of more than 1,500.
        checkpoint: a folder for the rows of the Gram matrix, or the passes, that are finished. Killed and started
            again with the same samples in the same order and the same folder, the run continues; rows of other samples
            and damaged ones are computed again. In the end the files are removed.

    Source: thesis 3.2.4, equation 8; Turk, Pentland 1991.
    """
    count, vertices, channels = samples.shape
    if count < 2:
        raise ShapeError(f"samples: found {count}, expected at least two to learn how they differ")
    if most is None and count > _WHOLE_SPECTRUM:
        most = _MAX_COMPONENTS
    most = count - 1 if most is None else min(most, count - 1)
    parts = list(blocks(samples, _BLOCK_BYTES))
    report = progress or silent
    folder = None if checkpoint is None else Path(checkpoint)
    if count > max(_GRAM_SAMPLES, 8 * most):
        return _by_passes(samples, parts, most, folder, report)
    work = 2 * len(parts) + len(parts) * (len(parts) + 1) // 2
    steps = iter(range(1, work + 1))

    def step() -> None:
        report(_STEP, next(steps), work)

    mean, floor, contents = _mean(samples, parts, step, keyed=folder is not None)
    gram = torch.zeros(count, count, dtype=torch.float64)
    rows = _Rows(folder, content_key(_METHOD, samples=contents, parts=parts))
    block: Tensor | None = None
    for number, (begin, end) in enumerate(parts):
        if (stored := rows.read(number, end - begin, end)) is not None:
            gram[begin:end, :end] = stored
            for _ in range(number + 1):
                step()
            continue
        block = _centred(samples, begin, end, mean)
        for first, last in parts[:number]:
            gram[begin:end, first:last] = block @ _centred(samples, first, last, mean).T
            step()
        # NumPy forms one triangle of a product of this kind and copies it, in half of torch's time.
        gram[begin:end, begin:end] = torch.from_numpy(block.numpy() @ block.numpy().T)
        step()
        rows.write(number, gram[begin:end, :end])
    trace = float(gram.diagonal().sum())
    values, vectors = largest_eigenpairs(gram, most)
    rank = _rank(values, floor, count)
    values, vectors = values[:rank], vectors[:, :rank]
    toward = (vectors / values.sqrt()).T.numpy()
    del gram, vectors
    # What is summed over several blocks stays in float64.
    components = np.empty((rank, vertices * channels), np.float32 if len(parts) == 1 else np.float64)
    for begin, end in parts:
        if block is None or len(parts) > 1:
            block = _centred(samples, begin, end, mean)
        for column in range(0, vertices * channels, _COLUMNS):
            columns = slice(column, column + _COLUMNS)
            product = toward[:, begin:end] @ block.numpy()[:, columns]
            components[:, columns] = product if begin == 0 else components[:, columns] + product
        step()
    rows.remove()
    return _learned(mean, torch.from_numpy(components), values, trace, count)


def _by_passes(
    samples: Samples, parts: list[tuple[int, int]], most: int, checkpoint: Path | None, report: Progress
) -> PrincipalComponents:
    count, vertices, channels = samples.shape
    mean, floor, contents = _mean(samples, parts, lambda: None, keyed=checkpoint is not None)
    if checkpoint is not None:
        make_folder(checkpoint)
    leading = leading_components(
        lambda begin, end: _centred(samples, begin, end, mean),
        parts,
        vertices * channels,
        most,
        checkpoint,
        content_key(_METHOD, samples=contents, parts=parts, components=most),
        lambda done, total: report(_STEP, done, total),
    )
    rank = _rank(leading.values, floor, count)
    if checkpoint is not None:
        (checkpoint / SUBSPACE).unlink(missing_ok=True)
        if not any(checkpoint.iterdir()):
            checkpoint.rmdir()
    return _learned(mean, leading.vectors[:rank], leading.values[:rank], leading.trace, count)


def _learned(mean: Tensor, components: Tensor, values: Tensor, trace: float, count: int) -> PrincipalComponents:
    """The components (K,D) with their signs settled, of eigenvalues (K,) of the scatter matrix of so many samples."""
    weights = torch.arange(components.shape[1], dtype=torch.float64).cos().to(components)
    components = components.mul_(torch.where(components @ weights < 0, -1.0, 1.0).to(components)[:, None])
    return PrincipalComponents(mean, components, (values / (count - 1)).sqrt(), trace / (count - 1))


def _rank(values: Tensor, floor: float, count: int) -> int:
    """How many eigenvalues (K,), falling, are more than rounding."""
    rank = int((values > max(floor, _NO_VARIANCE * float(values[0]))).sum())
    if rank == 0:
        raise ValueRangeError(f"samples: found {count} that are all the same, expected some that differ")
    return min(rank, count - 1)


def _mean(
    samples: Samples, parts: list[tuple[int, int]], step: Callable[[], None], keyed: bool
) -> tuple[Tensor, float, list[str]]:
    """The mean (D,) float64, the eigenvalue that rounding alone makes, and if asked for the key of each block."""
    total: Tensor | None = None
    largest = eps = 0.0
    contents = []
    for begin, end in parts:
        part = samples.read(begin, end).flatten(1)
        summed = torch.from_numpy(part.numpy().sum(0, dtype=np.float64))  # torch's takes ten times as long
        if not bool(torch.isfinite(summed).all()):
            bad = (~torch.isfinite(part)).any(1).nonzero()[:, 0] + begin
            raise ValueRangeError(f"samples: number {int(bad[0])} holds NaN or infinity; expected none")
        total = summed if total is None else total + summed
        least, most = part.aminmax()
        largest, eps = max(largest, float(most), -float(least)), torch.finfo(part.dtype).eps
        if keyed:
            contents.append(content_key(_METHOD, block=part))
        step()
    assert total is not None
    return total / samples.shape[0], (eps * largest) ** 2 * len(total), contents


def _centred(samples: Samples, begin: int, end: int, mean: Tensor) -> Tensor:
    return torch.from_numpy(np.subtract(samples.read(begin, end).flatten(1).numpy(), mean.numpy()))


class _Rows:
    """Finished rows of the Gram matrix on disk; with another key they begin anew."""

    def __init__(self, folder: Path | None, key: str) -> None:
        self._folder, self._key = folder, key
        if folder is not None:
            make_folder(folder)

    def read(self, number: int, rows: int, columns: int) -> Tensor | None:
        """The rows if they are there and whole."""
        checkpoint = None if self._folder is None else read_checkpoint(self._path(number), self._key)
        gram = None if checkpoint is None else checkpoint.get("rows")
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


@dataclass(frozen=True, eq=False)
class LeadingComponents:
    """What samples vary in most."""

    values: Tensor  # eigenvalues of the scatter matrix, the largest first, (K,) float64
    vectors: Tensor  # its orthonormal eigenvectors, (K,D) float64
    trace: float
    passes: int


def leading_components(
    read: Callable[[int, int], Tensor],
    parts: Sequence[tuple[int, int]],
    size: int,
    count: int,
    checkpoint: Path | None = None,
    key: str = "",
    report: Callable[[int, int], None] | None = None,
) -> LeadingComponents:
    r"""Subspace iteration on the scatter matrix, which is never made.

    .. math:: Z_p = Q_p X^\top X, \quad Q_{p+1} = \mathrm{orth}(Z_p)

    for centred samples X (M,D) and half as many rows Q more than components are wanted. Memory is two bases,
    :math:`24 K D` bytes, and a block of samples; a pass takes :math:`6 M D K` products. It ends when no eigenvalue
    changes by more than a millionth any more.

    Args:
        read: centred samples from one number up to another, without it, (N,D) float64.
        parts: begin and end of blocks that hold them all.
        size: D.
        count: K.
        checkpoint: a folder for the basis of each finished pass, from which a killed run goes on.
        report: called with the blocks that are done and how many there are at most.

    Source: Halko, Martinsson, Tropp 2011, Finding structure with randomness, algorithm 4.4.
    """
    rows = min(size, max(count + count // 2, count + 10))
    file = None if checkpoint is None else checkpoint / SUBSPACE
    kept = None if file is None else read_checkpoint(file, key)
    if kept is not None and kept["basis"].shape == (rows, size):
        basis, values, passes = kept["basis"], kept["values"], int(kept["passes"])
    else:
        start = torch.randn(size, rows, generator=torch.Generator().manual_seed(_SEED), dtype=torch.float64)
        basis, values, passes = torch.linalg.qr(start).Q.T, torch.zeros(count, dtype=torch.float64), 0
    steps = _steps(report, passes * len(parts), _MAX_PASSES * len(parts))
    while True:
        applied, inside = torch.zeros(rows, size, dtype=torch.float64), torch.zeros(rows, rows, dtype=torch.float64)
        trace = 0.0
        for begin, end in parts:
            block = read(begin, end)
            coefficients = block @ basis.T
            applied.addmm_(coefficients.T, block)
            inside.addmm_(coefficients.T, coefficients)
            trace += float(block.square().sum())
            next(steps)
        held, turned = torch.linalg.eigh(inside)
        before, values = values, held[-count:].flip(0).clamp(min=0)
        passes += 1
        if passes >= _MAX_PASSES or bool(((values - before).abs() <= _SETTLED * values).all()):
            return LeadingComponents(values, turned[:, -count:].flip(1).T @ basis, trace, passes)
        basis = torch.linalg.qr(applied.T).Q.T
        if file is not None:
            write_checkpoint(file, {"basis": basis, "values": values, "passes": torch.tensor(passes)}, key)


def _steps(report: Callable[[int, int], None] | None, done: int, total: int) -> Iterator[None]:
    while True:
        done += 1
        if report is not None:
            report(done, total)
        yield
