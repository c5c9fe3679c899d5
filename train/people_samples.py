"""People that an expression regression learns from: on disk, a file each, read a few at a time."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn.functional import normalize

from torchface import BlendshapeRig, Mesh, TorchfaceError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.sample_batches import Samples, SamplesInMemory, blocks
from torchface.progress import Progress
from torchface.registration.own_topology import check_own_topology

from .head_samples import check_triangles
from .sample_views import SampleRange, SamplesWithout
from .tensor_shards import Shards

_METHOD = "people of expressions/2"
_NEUTRAL, _SHAPE = "neutral", "shape:"
_LEAST_EXTENT, _MOST_EXTENT = 0.4, 2.5  # of a person beside the first
_LISTED = 5
# Of embedded performers' shapes the correlation with the others' of the name is 0.99 and more, 0.06 more than with any
# other; the shapes nearest to each other, a smile and a dimple, have 0.89, and their exchange is not found.
_ALIKE, _BETTER = 0.8, 0.3
_COMPARED = 2000  # vertices
_HELD_BYTES = 2**28
"""People who together take no more are read once: leaving each out in turn reads them hundreds of times."""


@dataclass(frozen=True, eq=False)
class People:
    """Who is learned from."""

    who: tuple[str, ...]  # M names
    template: Mesh  # the topology, and what is annotated on it
    neutrals: Samples  # (M,V,3), millimetres
    offsets: Samples  # of the expressions, one after the other, (M,N·V,3)
    names: tuple[str, ...]  # of the N expressions

    @staticmethod
    def of(who: Sequence[str], template: Mesh, neutrals: Tensor, offsets: Tensor, names: Sequence[str]) -> People:
        """Of neutrals (M,V,3) and offsets (M,N,V,3) in memory."""
        samples = SamplesInMemory(neutrals), SamplesInMemory(offsets.flatten(1, 2))
        return People(tuple(who), template, *samples, tuple(names))

    @property
    def expressions(self) -> Samples:
        """The people with each expression, (M,N·V,3)."""
        return Shown(self.neutrals, self.offsets)

    def neutral(self, number: int) -> Tensor:
        """Of one person, (V,3)."""
        return self.neutrals.read(number, number + 1)[0]

    def offsets_of(self, number: int) -> Tensor:
        """Of one person, (N,V,3)."""
        return self.offsets.read(number, number + 1)[0].unflatten(0, (len(self.names), -1))

    def without(self, left_out: int) -> People:
        """All but one."""
        return replace(
            self,
            who=self.who[:left_out] + self.who[left_out + 1 :],
            neutrals=SamplesWithout(self.neutrals, left_out),
            offsets=SamplesWithout(self.offsets, left_out),
        )

    def first(self, count: int) -> People:
        """So many of them, the first."""
        return replace(
            self,
            who=self.who[:count],
            neutrals=SampleRange(self.neutrals, 0, count),
            offsets=SampleRange(self.offsets, 0, count),
        )

    def mean_rig(self) -> BlendshapeRig:
        """The mean neutral with the mean offsets."""
        deltas = _mean(self.offsets).unflatten(0, (len(self.names), -1))
        return BlendshapeRig(self.template.with_vertices(_mean(self.neutrals)), deltas, self.names)


@dataclass(frozen=True, eq=False)
class Shown:
    """Expressions (M,N·V,3): neutrals (M,V,3) and offsets (M,N·V,3) added."""

    neutrals: Samples
    offsets: Samples

    @property
    def shape(self) -> tuple[int, ...]:
        """M, N·V, 3."""
        return self.offsets.shape

    def read(self, begin: int, end: int) -> Tensor:
        """See ``Samples``."""
        neutral, offsets = self.neutrals.read(begin, end), self.offsets.read(begin, end)
        return (offsets.view(len(neutral), -1, *neutral.shape[1:]) + neutral[:, None]).flatten(1, 2)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Tensors of shards one after the other, each row (V,3), as samples."""

    shards: Shards

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.shards), sum(size[0] for _, size in self.shards.forms.values()), 3)

    def read(self, begin: int, end: int) -> Tensor:
        samples = self.shards.read(begin, end)
        return torch.cat([samples[name] for name in self.shards.names], dim=1)


def gather(
    who: Sequence[str],
    read: Callable[[int], BlendshapeRig],
    key: Callable[[int], str],
    work: Path,
    where: str,
    progress: Progress,
) -> People:
    """Writes all people, a file each; those that an earlier run has written of the same ``key`` are not read again."""
    make_folder(work)
    first = read(0)
    topology = first.neutral.fingerprint()
    beside = extent(first.vertices[first.neutral.faces.flatten()])
    paths = [work / f"person_{number:06}.safetensors" for number in range(len(who))]
    shapes: list[list[str]] = []
    for number, path in enumerate(paths):
        own = content_key(_METHOD, person=key(number), topology=topology)
        if read_checkpoint(path, own) is None:
            rig = first if number == 0 else read(number)
            name = f"{where}: {who[number]}"
            check_triangles(first.neutral, rig.neutral, name, who[0])
            used = rig.vertices[rig.neutral.faces.flatten()]
            check_unit(name, used, beside, who[0], _LEAST_EXTENT, _MOST_EXTENT, alone=True)
            check_own_topology(first.neutral, rig.neutral, name, who[0])
            kept = {f"{_SHAPE}{name}": delta[None] for name, delta in zip(rig.names, rig.deltas, strict=True)}
            write_checkpoint(path, {_NEUTRAL: rig.vertices[None], **kept}, own)
        with safe_open(path, framework="pt") as file:
            shapes.append([name.removeprefix(_SHAPE) for name in file.keys() if name != _NEUTRAL])  # noqa: SIM118
        progress("gathering people", number + 1, len(who))
    names = _common(first.names, who, shapes, where)
    neutrals, offsets = Shards(paths, [_NEUTRAL]), Shards(paths, [f"{_SHAPE}{name}" for name in names])
    return _held(People(tuple(who), first.neutral, _Rows(neutrals), _Rows(offsets), names))


def _common(first: Sequence[str], who: Sequence[str], shapes: list[list[str]], where: str) -> tuple[str, ...]:
    """The expressions that all people have, in the first one's order; says whose files lack those that most have."""
    count = Counter(name for own in shapes for name in own)
    usual = [name for name, times in count.items() if 2 * times > len(who)]
    lacks = []
    for person, own in zip(who, shapes, strict=True):
        if lacking := sorted(set(usual) - set(own)):
            instead = sorted(set(own) - set(usual))
            has = f" (it has {_some(instead)} instead)" if instead else ""
            lacks.append(f"{person} lacks {_some(lacking)}{has}")
    names = tuple(name for name in first if count[name] == len(who))
    if not names:
        found = _some(lacks) or _some([f"{one} has {_some(own)}" for one, own in zip(who, shapes, strict=True)])
        raise TorchfaceError(f"{where}: found no expression that all {len(who)} people have, expected one: {found}")
    if lacks:
        left_out = sorted(set(usual) - set(names))
        warnings.warn(f"{where}: {_some(left_out)} left out: {_some(lacks)}", stacklevel=3)
    return names


def _some(names: Sequence[str]) -> str:
    """The first few of many."""
    return ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")


def warn_of_exchanged(people: People, where: str) -> None:
    """Warns of a person's expression that moves as the others' of another name does, and not as theirs of its own.

    By the correlation of offsets with the sums of the others' offsets.
    """
    step = max(1, people.neutrals.shape[1] // _COMPARED)
    read = lambda number: people.offsets_of(number)[:, ::step].flatten(1)  # noqa: E731
    total = torch.zeros_like(read(0))
    for number in range(len(people.who)):  # few are in memory at a time
        total += read(number)
    for number, person in enumerate(people.who):
        own = read(number)
        alike = normalize(own, dim=1) @ normalize(total - own, dim=1).T
        best, which = alike.max(1)
        far = ((best > _ALIKE) & (best > alike.diagonal() + _BETTER)).nonzero()[:, 0].tolist()
        found = [
            f"{people.names[row]} as their {people.names[int(which[row])]} (correlation {float(best[row]):.2f}, with "
            f"their {people.names[row]} {float(alike[row, row]):.2f})"
            for row in far
        ]
        if found:
            warnings.warn(
                f"{where}: {person} moves unlike the other people: {_some(found)}: look whether files are exchanged",
                stacklevel=2,
            )


def _held(people: People) -> People:
    """People in memory if they are few."""
    count, places, _ = people.offsets.shape
    if 12 * count * (places + people.neutrals.shape[1]) > _HELD_BYTES:
        return people
    whole = (SamplesInMemory(samples.read(0, count)) for samples in (people.neutrals, people.offsets))
    return replace(people, neutrals=next(whole), offsets=next(whole))


def _mean(samples: Samples) -> Tensor:
    total = torch.zeros(samples.shape[1:], dtype=torch.float64)
    for begin, end in blocks(samples):
        total += samples.read(begin, end).sum(0, dtype=torch.float64)
    return (total / samples.shape[0]).float()
