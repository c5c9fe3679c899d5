"""The actor's timing: velocity profiles of real motions that were left out, linear, eased and retimed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from torch import Tensor

from torchface.enhancement.retiming import retime_features
from torchface.io import load_take
from torchface.shape_names import mapping
from torchface.synthetic.head.performer import performer

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


@pytest.mark.real
def test_velocity_profiles_of_motions_that_were_left_out(performances: list[Path]) -> None:
    """Two takes against the four others; features are displacements, exact in as many numbers as shapes."""
    rig = performer(texture=False)
    assert rig.neutral.annotations is not None
    takes = []
    for path in performances:
        track = load_take(path).weights
        assert track is not None
        takes.append((track.values[..., 0] @ mapping(track.names, rig.names).T).clamp(0, 1).double())
    print(
        "\ndistance of velocity profiles from the actor's own, shares of linear blending's, motions of two takes left"
    )
    print(
        f"out; in brackets of profiles smoothed by 0.05 of the motion\n{'region':>13} {'motions':>8} {'linear':>7}",
        end="",
    )
    print("".join(f"{name:>16}" for name in ("ease-in/out", "nearest motion", "mean of eight")))
    together: list[np.ndarray] = []
    for name, parts in REGIONS.items():
        inside = torch.stack([torch.as_tensor(rig.neutral.annotations.regions[part]).float() for part in parts])
        vertices = inside.amax(0).gt(0.5).nonzero()[:, 0]
        flat = rig.deltas[:, vertices].double().flatten(1) / len(vertices) ** 0.5
        values, vectors = torch.linalg.eigh(flat @ flat.T)
        paths = [take @ (vectors * values.clamp(min=0).sqrt()) for take in takes]
        found = [motions(path, LEAST[name]) for path in paths]
        rows = []
        for left_out in ((4, 5),):
            # A captured sequence is a motion with the hold before and after it.
            pieces = [paths[t][first : last + 1] for t in range(6) if t not in left_out for first, last in found[t]]
            database = torch.cat(pieces)[:, None]
            numbers = torch.arange(len(pieces)).repeat_interleave(torch.tensor([len(piece) for piece in pieces]))
            for take in left_out:
                for first, last in found[take]:
                    own = paths[take][first : last + 1]
                    way = own[-1] - own[0]
                    even = torch.linspace(0, 1, len(own), dtype=torch.float64)
                    retimed = [
                        retime_features(own[[0, -1]][:, None], database, numbers, torch.ones(1, 1), len(own), nearest)[
                            0
                        ]
                        for nearest in (1, 8)
                    ]
                    curves = [(own - own[0]) @ way / (way @ way), even, 3 * even**2 - 2 * even**3, *retimed]
                    row = []
                    for smoothing in (0.0, 0.05):
                        actor, *others = (profile(curve, smoothing) for curve in curves)
                        row.append([float(np.sqrt(np.mean((other - actor) ** 2))) for other in others])
                    rows.append(row)
        table = np.array(rows)
        together.append(table)
        print_row(name, table)
    every = np.concatenate(together)
    print_row("all", every)
    linear, eased, _, retimed = every[:, 1].mean(0)
    assert retimed < eased < linear


def print_row(name: str, table: np.ndarray) -> None:
    raw, smooth = table.mean(0)
    shares = "".join(f"{a:>9.2f} ({b:.2f})" for a, b in zip(raw[1:] / raw[0], smooth[1:] / smooth[0], strict=True))
    print(f"{name:>13} {len(table):>8} {raw[0]:>7.2f}{shares}")
