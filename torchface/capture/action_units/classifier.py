"""A classifier of action units and their intensities from painted regions of the face."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.action_units.gabor import GaborBank
from torchface.capture.action_units.one_vs_one_svm import OneVsOne
from torchface.capture.action_units.painted_regions import RegionGroup, performed_groups
from torchface.capture.action_units.region_video import RegionVideo
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.io.action_labels import ActionLabels
from torchface.progress import Progress

_MAX_COUNT = 4096
_MAX_CLASSES = 256  # there is a plane for every two


class GroupClassifier(nn.Module):
    """Gabor features of merged regions against rest, principal components, a vote between C classes (the first is
    rest), a table of levels."""

    mean: Tensor
    components: Tensor
    deviations: Tensor
    intensities: Tensor

    def __init__(self, group: RegionGroup, size: int, components: int, classes: int) -> None:
        super().__init__()
        self.group = group
        self.gabor = GaborBank()
        places = self.gabor.places(size)
        features = len(group.regions) * len(self.gabor.even) * places**2
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("components", torch.zeros(components, features))
        self.register_buffer("deviations", torch.ones(components))
        self.machine = OneVsOne(classes, components)
        self.register_buffer("intensities", torch.zeros(classes, len(group.units)))

    def features(self, images: Tensor, rest: Tensor) -> Tensor:
        """Gabor magnitudes of the group's regions (B,G,h,w) less those of this performer at rest, (B,D).

        Patterns differ between faces; the change that an expression makes differs less.
        """
        return self.magnitudes(images) - self.magnitudes(rest if rest.ndim == 4 else rest[None])

    def magnitudes(self, images: Tensor) -> Tensor:
        """Of the Gabor filters, (B,D), of the group's regions (B,G,h,w), merged."""
        return self.gabor(images.flatten(0, 1)).reshape(images.shape[0], len(self.mean))

    def scores(self, images: Tensor, rest: Tensor) -> Tensor:
        """Of every class, (B,C), for regions (B,G,h,w) and the regions at rest (G,h,w)."""
        reduced = (self.features(images, rest) - self.mean) @ self.components.T / self.deviations
        scores: Tensor = self.machine(reduced)
        return scores

    def forward(self, images: Tensor, rest: Tensor) -> Tensor:
        """Intensities (B,A) of the group's units, for its regions (B,G,h,w) and those at rest (G,h,w)."""
        known = torch.isfinite(images).flatten(1).all(1, keepdim=True) & torch.isfinite(rest).all()
        return torch.where(known, self.intensities[self.scores(images, rest).argmax(1)], torch.nan)


@dataclass(frozen=True)
class TrainingSettings:
    """How a classifier is trained.

    Args:
        levels: of intensity, the lowest of them rest.
        variance: fraction of the features' variance that the principal components explain.
        penalty: of the support vector machines.
        warps: replicas of every frame, each warped at random: faces and paint of others differ so.
        warp_amplitude: of their control points, pixels.
        seed: of k-means and the warps.

    Example:
        >>> TrainingSettings(levels=3).levels  # rest, and two intensities
        3
    """

    levels: int = 4
    variance: float = 0.9
    penalty: float = 10.0
    warps: int = 1
    warp_amplitude: float = 0.8
    seed: int = 0

    def __post_init__(self) -> None:
        if self.levels < 2 or not 0 < self.variance <= 1 or not self.penalty > 0 or self.warps < 0:
            raise ValueRangeError(
                f"training settings: found {self}, expected levels >= 2, a variance in (0,1], a positive penalty and "
                "warps >= 0"
            )


DEFAULT_TRAINING = TrainingSettings()


@dataclass(frozen=True)
class GroupSize:
    """How many components and classes a group's classifier has learned."""

    components: int
    classes: int


class ActionUnitClassifier(nn.Module):
    """Intensities of action units from painted regions, every frame on its own.

    Args:
        groups: which regions show which units.
        sizes: what each group has learned.
        size: pixels a side of a region.

    Raises:
        NameMismatchError: a unit is in two groups, or a group is empty.

    Source: thesis 4.1.10 to 4.1.12.
    """

    neutral: Tensor

    def __init__(self, groups: Sequence[RegionGroup], sizes: Sequence[GroupSize], size: int) -> None:
        super().__init__()
        check_groups(groups)
        self.groups, self.size = tuple(groups), size
        self.regions = group_regions(groups)
        self.units: tuple[str, ...] = tuple(unit for group in groups for unit in group.units)
        self.parts = nn.ModuleList(
            GroupClassifier(group, size, own.components, own.classes) for group, own in zip(groups, sizes, strict=True)
        )
        # The first training performer's face at rest, to which others are warped.
        self.register_buffer("neutral", torch.zeros(len(self.regions), size, size))

    @classmethod
    def fit(
        cls,
        videos: Sequence[RegionVideo],
        labels: Sequence[ActionLabels],
        groups: Sequence[RegionGroup] | None = None,
        settings: TrainingSettings = DEFAULT_TRAINING,
        progress: Progress | None = None,
    ) -> "ActionUnitClassifier":
        """Learns from one or several performers.

        Args:
            videos: each performer's regions; all but the first warped to the first's ``neutral``.
            labels: of each video, with what was performed.
            groups: which regions show which units; the labels', or the usual ones, of what is performed, if absent.
            settings: of the training.
            progress: called with each step and how far it is.

        Raises:
            ShapeError: videos and labels differ in number or length.
            NameMismatchError: regions are missing, a unit of a group is never performed, or an unknown one is.

        Example:
            >>> from torchface.io.action_labels import Performed
            >>> height = 6 + 9 * torch.linspace(0, 3.1416, 60).sin() ** 2  # a painted brow, up and down again
            >>> stroke = torch.exp(-(((torch.arange(24.0) - height[:, None]) / 2.5) ** 2))
            >>> shown = stroke[:, None, :, None].repeat(1, 1, 1, 24).float()
            >>> video = RegionVideo(("brow",), shown, shown[0], shown[0], fps=30.0)
            >>> box = {"brow": (0, 0, 24, 24)}
            >>> labels = ActionLabels(60, 0, (0, 0), ((0, 0), (9, 9)), box, (Performed(("1",), 2, 58),))
            >>> brow = (RegionGroup("brow", ("brow",), ("1",)),)
            >>> classifier = ActionUnitClassifier.fit([video], [labels], brow)
            >>> with torch.no_grad():
            ...     intensity = classifier(shown, shown[0])[:, 0]
            >>> intensity[0].item(), intensity[30].item()
            (0.0, 1.0)
        """
        from torchface.capture.action_units.classifier_training import fit_classifier

        groups = performed_groups(labels) if groups is None else groups
        return fit_classifier(videos, labels, groups, settings, progress)

    @property
    def config(self) -> dict[str, Any]:
        """What :meth:`from_config` needs beside the state: plain values only."""
        return {
            "size": self.size,
            "groups": [
                {
                    "name": part.group.name,
                    "regions": list(part.group.regions),
                    "units": list(part.group.units),
                    "other_units": list(part.group.other_units),
                    "components": len(part.components),
                    "classes": len(part.intensities),
                }
                for part in self.group_classifiers()
            ],
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "ActionUnitClassifier":
        """A classifier of zeros for the state to be loaded into.

        Raises:
            FileFormatError: a value is missing or out of range.
        """
        values = Value("config", "", config)
        groups, sizes = [], []
        for entry in values["groups"].rows(1, 64):
            names = [entry[name].texts() for name in ("regions", "units", "other_units")]
            groups.append(RegionGroup(entry["name"].text(), *names))
            sizes.append(GroupSize(entry["components"].whole(1, _MAX_COUNT), entry["classes"].whole(2, _MAX_CLASSES)))
        return cls(groups, sizes, values["size"].whole(8, _MAX_COUNT))

    def group_classifiers(self) -> list[GroupClassifier]:
        """One a group."""
        return [part for part in self.parts if isinstance(part, GroupClassifier)]

    def forward(self, regions: Tensor, rest: Tensor) -> Tensor:
        """Intensities (B,A) in [0,1], in the order of ``units``; NaN of what a pattern with NaN or infinity shows.

        Args:
            regions: patterns (B,R,h,w) in [0,1], in the order of ``regions``, warped to ``neutral``; see
                :func:`torchface.capture.action_units.read_regions`.
            rest: the same of this performer's face at rest, (R,h,w).

        Raises:
            ShapeError: another shape.
        """
        parts = self.group_classifiers()
        own, still = self.split(regions), self.split(rest[None])
        return torch.cat([part(a, b) for part, a, b in zip(parts, own, still, strict=True)], dim=1)

    def split(self, regions: Tensor) -> list[Tensor]:
        """Each group's regions (B,G,h,w)."""
        if regions.ndim != 4 or tuple(regions.shape[1:]) != (len(self.regions), self.size, self.size):
            raise ShapeError(
                f"regions: found {tuple(regions.shape)}, expected (B,{len(self.regions)},{self.size},{self.size})"
            )
        return [regions[:, [self.regions.index(name) for name in group.regions]] for group in self.groups]


def group_regions(groups: Sequence[RegionGroup]) -> tuple[str, ...]:
    """Every region of the groups once, in order."""
    return tuple(dict.fromkeys(region for group in groups for region in group.regions))


def check_groups(groups: Sequence[RegionGroup]) -> None:
    """Raises ``NameMismatchError`` where a group is empty, or a unit is in two."""
    units = [unit for group in groups for unit in group.units]
    if not groups or any(not group.regions or not group.units for group in groups):
        raise NameMismatchError(f"groups: found {list(groups)!r:.120}, expected regions and units in each")
    twice = sorted({unit for unit in units if units.count(unit) > 1})
    if twice:
        raise NameMismatchError(f"groups: found {', '.join(twice)} in more than one group, expected each unit in one")
