"""The actor's timing: velocity profiles of real motions that were left out, linear, eased and retimed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from torch import Tensor

from torchface.enhancement.timing.actor_timing import ActorTiming
from torchface.enhancement.timing.nearest_timing import captured_sequences, nearest_timing
from torchface.io import load_take
from torchface.shape_names import mapping
from torchface.synthetic.head.performer import performer

FPS = 60.0  # of the takes
REGIONS = {
    "brows": ("forehead", "brow_left", "brow_right"),
    "left lids": ("lids_left",),
    "right lids": ("lids_right",),
    "mouth": ("upper_lip", "lower_lip", "chin", "jaw"),
    "cheeks, nose": ("cheek_left", "cheek_right", "nose"),
}
LEAST = {"brows": 0.4, "left lids": 0.6, "right lids": 0.6, "mouth": 0.3, "cheeks, nose": 0.3}  # mm, root mean square


def motions(path: Tensor, least: float) -> list[tuple[int, int]]:
    """First and last frames of motions between holds, where the speed falls below 0.3 of both neighbouring peaks."""
    smooth = gaussian_filter1d(path.numpy(), 2.0, axis=0, mode="nearest")
    speed = np.linalg.norm(np.gradient(smooth, axis=0), axis=1)
    holds, _ = find_peaks(-np.log(speed + 1e-4 * speed.max()), prominence=np.log(1 / 0.3))
    found = []
    for begin, end in zip([0, *holds], [*holds, len(speed) - 1], strict=True):
        moving = np.flatnonzero(speed[begin : end + 1] >= 0.08 * speed[begin : end + 1].max())
        first, last = max(begin + moving[0] - 1, 0), min(begin + moving[-1] + 1, len(speed) - 1)
        way = np.linalg.norm(smooth[last] - smooth[first])
        length = np.linalg.norm(np.diff(smooth[first : last + 1], axis=0), axis=1).sum()
        if 4 <= last - first <= 180 and way >= least and way > 0.6 * length:
            found.append((int(first), int(last)))
    return found


def profile(progress: Tensor, smoothing: float) -> np.ndarray:
    """Speed along the way from the first keyframe to the last, 1 in the mean, at 40 moments."""
    moments = np.interp(np.linspace(0, 1, 41), np.linspace(0, 1, len(progress)), progress.numpy())
    speed = 40 * np.diff(moments)
    return gaussian_filter1d(speed, 40 * smoothing, mode="nearest") if smoothing else speed


@dataclass(frozen=True, eq=False)
class Motions:
    """The motions of one region in all takes."""

    name: str
    paths: list[Tensor]
    found: list[list[tuple[int, int]]]

    def captured(self, takes: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Features (K,1,D) and sequences (K,) of the motions of some takes, each with the hold before and after it."""
        pieces = [self.paths[take][first : last + 1] for take in takes for first, last in self.found[take]]
        lengths = torch.tensor([len(piece) for piece in pieces])
        return torch.cat(pieces)[:, None], torch.arange(len(pieces)).repeat_interleave(lengths)

    def actor(self, take: int, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Both keyframes' features (2,1,D) and how far the actor has come in each frame."""
        own = self.paths[take][first : last + 1]
        way = own[-1] - own[0]
        return own[[0, -1]][:, None], (own - own[0]) @ way / (way @ way)


@pytest.fixture(scope="module")
def regions(performances: list[Path]) -> list[Motions]:
    """Features are displacements, exact in as many numbers as shapes."""
    rig = performer(texture=False)
    takes = []
    for path in performances:
        track = load_take(path).weights
        takes.append((track.values[..., 0] @ mapping(track.names, rig.names).T).clamp(0, 1).double())
    every = []
    for name, parts in REGIONS.items():
        inside = torch.stack([torch.as_tensor(rig.neutral.annotations.regions[part]).float() for part in parts])
        vertices = inside.amax(0).gt(0.5).nonzero()[:, 0]
        flat = rig.deltas[:, vertices].double().flatten(1) / len(vertices) ** 0.5
        values, vectors = torch.linalg.eigh(flat @ flat.T)
        paths = [take @ (vectors * values.clamp(min=0).sqrt()) for take in takes]
        every.append(Motions(name, paths, [motions(path, LEAST[name]) for path in paths]))
    return every


WAYS = ("linear", "ease-in/out", "nearest motion", "mean of eight", "learned")
HINDSIGHT = ("captured", "symmetric", "smoothed")


def courses(region: Motions, known: Sequence[int], asked: Sequence[int]) -> Iterator[tuple[Tensor, list[Tensor]]]:
    """Of each motion of the takes asked for how far the actor came in each frame, and what each way says."""
    database, numbers = region.captured(known)
    timing, owned = ActorTiming(database, numbers, torch.ones(1, 1), FPS), captured_sequences(database, numbers)
    for take in asked:
        for first, last in region.found[take]:
            keyframes, actor = region.actor(take, first, last)
            frames, length = len(actor), len(actor) - 1.0
            even = torch.linspace(0, 1, frames, dtype=torch.float64)
            near = [nearest_timing(keyframes, owned, torch.ones(1), frames, length, count) for count in (1, 8)]
            timed = timing.times(keyframes, frames, length)[0]
            yield actor, [even, 3 * even**2 - 2 * even**3, *near, timed]


def distances(region: Motions, known: Sequence[int], asked: Sequence[int]) -> np.ndarray:
    """Of velocity profiles from the actor's own, (motions, 2, ways and hindsights), plain and smoothed.

    In hindsight: the captured profile that is nearest to the actor's own, the nearest that is symmetric, and his own
    when his path is smoothed by a frame: the capture's noise, and what is quickest in a blink.
    """
    captured = [region.actor(take, first, last)[1] for take in known for first, last in region.found[take]]
    rows = []
    for actor, curves in courses(region, known, asked):
        row = []
        for smoothing in (0.0, 0.05):
            own = profile(actor, smoothing)
            quiet = torch.from_numpy(gaussian_filter1d(actor.numpy(), 1.0, mode="nearest"))
            best = min(root_mean_square(profile(other, smoothing) - own) for other in captured)
            row.append(
                [
                    *(root_mean_square(profile(curve, smoothing) - own) for curve in curves),
                    best,
                    root_mean_square((own - own[::-1]) / 2),
                    root_mean_square(profile(quiet, smoothing) - own),
                ]
            )
        rows.append(row)
    return np.array(rows)


def root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def table(regions: list[Motions], splits: Sequence[tuple[Sequence[int], Sequence[int]]]) -> dict[str, np.ndarray]:
    """Mean plain distances by region, as shares of linear blending's; printed."""
    columns = (*WAYS[1:], *HINDSIGHT)
    print(f"{'region':>13} {'motions':>8} {'linear':>7}" + "".join(f"{name:>16}" for name in columns))
    every, shares = [], {}
    for region in regions:
        rows = [distances(region, known, asked) for known, asked in splits]
        every.append(np.concatenate([row for row in rows if len(row)]))
    for name, rows in zip([*REGIONS, "all"], [*every, np.concatenate(every)], strict=True):
        plain, smooth = rows.mean(0)
        shares[name] = plain[1:] / plain[0]
        pairs = zip(shares[name], smooth[1:] / smooth[0], strict=True)
        print(f"{name:>13} {len(rows):>8} {plain[0]:>7.2f}" + "".join(f"{a:>9.2f} ({b:.2f})" for a, b in pairs))
    return shares


@pytest.mark.real
def test_velocity_profiles_of_motions_that_were_left_out(regions: list[Motions]) -> None:
    """Two takes against the four others.

    Two poses and a duration do not tell the profile of a brow, a cheek or a mouth: the best of all symmetric profiles,
    chosen in hindsight, stays at 0.65 of linear blending's distance; smoothing the actor's own by a frame makes 0.34.
    """
    print("\ndistance of velocity profiles from the actor's own, shares of linear blending's, two takes left out; in")
    print("brackets of profiles smoothed by 0.05 of the motion; the last three columns know the actor's own")
    shares = table(regions, [((0, 1, 2, 3), (4, 5))])
    eased, _, eight, learned = shares["all"][:4]
    assert learned < 0.73
    assert learned < eight < eased
    assert all(region[3] < 1.02 * region[0] for region in shares.values())
    assert shares["left lids"][3] < 0.61
    assert shares["right lids"][3] < 0.61


@pytest.mark.real
def test_the_default_is_what_is_better_on_takes_left_out_of_the_database(regions: list[Motions]) -> None:
    """Each of the database's two takes of most motions against its three others; the test takes stay unseen."""
    print("\nthe same inside the database, a take left out at a time")
    splits = [([take for take in range(4) if take != out], [out]) for out in (2, 3)]
    shares = table(regions, splits)
    assert shares["all"][3] < shares["all"][2]


@pytest.mark.real
def test_displacement_curves_of_a_motion_that_was_left_out(regions: list[Motions]) -> None:
    """The paper's figure 7: linear, matched and actor, of the median of the left lids' motions and of the mouth's."""
    print(
        f"\ndistance from the actor's displacement, share of the way\n{'region':>13}"
        + "".join(f"{w:>16}" for w in WAYS)
    )
    for name in ("left lids", "mouth"):
        region = next(region for region in regions if region.name == name)
        shown = list(courses(region, (0, 1, 2, 3), (4, 5)))
        errors = np.array([[root_mean_square((curve - own).numpy()) for curve in curves] for own, curves in shown])
        print(f"{name:>13}" + "".join(f"{error:>16.3f}" for error in errors.mean(0)))
        assert errors.mean(0)[-1] < errors.mean(0)[0]
