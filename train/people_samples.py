"""People that an expression regression learns from: on disk, a file each, read a few at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from torchface import BlendshapeRig, Mesh, TorchfaceError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder
from torchface.geometry.sample_batches import Samples, SamplesInMemory, blocks
from torchface.progress import Progress

from .sample_views import SampleRange, SamplesWithout
from .tensor_shards import Shards

_METHOD = "people of expressions/1"
_NEUTRAL, _SHAPE = "neutral", "shape:"
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
    paths = [work / f"person_{number:06}.safetensors" for number in range(len(who))]
    common = set(first.names)
    for number, path in enumerate(paths):
        own = content_key(_METHOD, person=key(number), topology=topology)
        if read_checkpoint(path, own) is None:
            rig = first if number == 0 else read(number)
            if rig.neutral.fingerprint() != topology:
                raise TorchfaceError(
                    f"{where}: found {who[number]} of topology {rig.neutral.fingerprint()}, expected that of {who[0]}, "
                    f"{topology}"
                )
            shapes = {f"{_SHAPE}{name}": delta[None] for name, delta in zip(rig.names, rig.deltas, strict=True)}
            write_checkpoint(path, {_NEUTRAL: rig.vertices[None], **shapes}, own)
        with safe_open(path, framework="pt") as file:
            common &= {name.removeprefix(_SHAPE) for name in file.keys() if name != _NEUTRAL}  # noqa: SIM118
        progress("gathering people", number + 1, len(who))
    names = tuple(name for name in first.names if name in common)
    if not names:
        raise TorchfaceError(f"{where}: found no expression that all {len(who)} people have, expected one")
    neutrals, offsets = Shards(paths, [_NEUTRAL]), Shards(paths, [f"{_SHAPE}{name}" for name in names])
    return _held(People(tuple(who), first.neutral, _Rows(neutrals), _Rows(offsets), names))


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
