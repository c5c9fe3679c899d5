"""Marker sites from a range of motion: how many come within a millimetre, what that does to the weights, how long."""

from __future__ import annotations

import time

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, align_take, fit_attachment, rest_residual
from torchface.geometry.alignment import Similarity
from torchface.synthetic import performer
from torchface.synthetic.marker_sites import misplaced, site_distances
from torchface.synthetic.marker_stage import StageFlaws, place_markers, record
from torchface.synthetic.performance import perform

Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]


def embedded() -> Capture:
    rig = performer(texture=False)
    generator = torch.Generator().manual_seed(0)
    tracks = [perform(1850, generator).weights for _ in range(2)]
    return rig, place_markers(rig, 100), [rig.weights_from(track) for track in tracks if track is not None]


def space(seed: int) -> Similarity:
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)))[0]
    return Similarity(
        torch.tensor([1.07]), (turn * torch.linalg.det(turn).sign())[None], torch.tensor([[100.0, -900.0, 40.0]])
    )


def filmed(capture: Capture, take: int, seed: int, standoff: float) -> Take:
    rig, attachment, takes = capture
    flaws = StageFlaws(standoff=standoff)
    markers = record(rig, attachment, takes[take], torch.Generator().manual_seed(seed), flaws).take.markers
    assert markers is not None
    return Take(60.0, markers=Track(markers.names, space(seed).apply(markers.values)))


def weight_error(rig: BlendshapeRig, sites: Attachment, take: Take, true: Tensor) -> float:
    alignment = align_take(rig, sites, take)
    weights = MarkerSolver(rig, rest_residual(rig, sites, take, alignment), alignment).solve_take(take).weights
    assert weights is not None
    return float((weights.values[..., 0] - true).abs().mean())


def table(name: str, capture: Capture, standoff: float) -> list[tuple[float, float]]:
    rig, attachment, takes = capture
    print(f"\n{name}, {len(rig.names)} shapes, {len(attachment.triangles)} markers, stand-off {standoff:g} mm")
    print("ROM  frames  within 1 mm  median   worst  found  rounds  CPU s | next take: fitted  nearest vertex  ratio")
    rows = []
    for rom in range(len(takes)):
        start = misplaced(rig, attachment, torch.Generator().manual_seed(rom))
        take = filmed(capture, rom, rom, standoff)
        started = time.process_time()
        fit = fit_attachment(rig, take, start, standoff=standoff > 0)
        seconds = time.process_time() - started
        off = site_distances(rig, fit.attachment, attachment)
        other = (rom + 1) % len(takes)
        played = filmed(capture, other, 10 + rom, standoff)
        points = start.on(rig.neutral.faces, rig.vertices)
        nearest = Attachment.from_vertices(rig.neutral, torch.cdist(points, rig.vertices).argmin(1), start.labels)
        ours = weight_error(rig, fit.attachment, played, takes[other])
        theirs = weight_error(rig, nearest, played, takes[other])
        share = float((off < 1).double().mean())
        rows.append((share, ours / theirs))
        print(
            f"{rom + 1:3}  {len(takes[rom]):6}  {100 * share:9.0f} %  {float(off.median()):4.2f} mm "
            f"{float(off.max()):4.2f} mm "
            f"{fit.standoff:4.2f} mm {len(fit.errors):5} {seconds:7.1f} | "
            f"{ours:17.4f} {theirs:15.4f} {ours / theirs:6.2f}"
        )
    return rows


@pytest.mark.parametrize("standoff", [0.0, 2.0])
def test_on_the_performer(standoff: float) -> None:
    for share, ratio in table("the embedded performer", embedded(), standoff):
        assert share >= (0.85 if standoff else 0.95)
        assert ratio <= 0.6


@pytest.mark.real
@pytest.mark.parametrize("standoff", [0.0, 2.0])
def test_on_a_real_rig(real_capture: Capture, standoff: float) -> None:
    for share, ratio in table("a real rig, six real takes", real_capture, standoff):
        assert share >= (0.85 if standoff else 0.95)
        assert ratio <= 0.6
