"""Claim: the head that ``track`` solves with a film, of 68 landmarks, points of the surface and read expressions, is
nearer to who is filmed than the head model's mean and than the head of the landmarks alone.

Four rendered films of unseen people. Errors are mean distances of 452 points after the best similarity, millimetres.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from torch import Tensor

from torchface.geometry.similarity import similarity_transform
from torchface.progress import silent
from torchface.rig import BlendshapeRig
from torchface.workflows.surface_sites import sites_on_rig
from torchface.workflows.track.frame_readings import read_frames
from torchface.workflows.track.person_head import HeadFrames, person_head
from torchface.workflows.track.take_solution import smoothed_landmarks
from torchface.workflows.track.track_inputs import TrackSettings, load_inputs
from torchface.workflows.track.track_state import TrackState
from train.expression_films import Settings, render

pytestmark = [pytest.mark.real, pytest.mark.bench]


def apart(points: Tensor, truth: Tensor) -> float:
    moved = similarity_transform(points[None].double(), truth[None].double()).apply(points[None].double())[0]
    return float((moved - truth.double()).norm(dim=1).mean())


def test_heads_of_films(data: Path) -> None:
    torch.set_num_threads(1)
    ict = data / "ict_facekit" / "FaceXModel"
    films = render(Settings(out=Path("out/expression_films/small"), takes=data / "performances", ict=ict, small=True))
    rows = []
    for name, film in films.items():
        inputs = load_inputs(film.path, None, TrackSettings())
        with TemporaryDirectory() as folder:
            reading, _ = read_frames(inputs, TrackState(Path(folder), inputs.reading_key), silent)
        marks = smoothed_landmarks(inputs, reading, None)
        bare = replace(inputs, models=replace(inputs.models, places=torch.zeros(0, 3)))
        unread = replace(reading, expression=torch.full_like(reading.expression, torch.nan))
        filmed = HeadFrames.of(inputs, marks, reading)
        heads = [
            inputs.actor,
            person_head(bare, inputs.heads, HeadFrames(filmed.numbers), marks, unread, silent).rig,
            person_head(inputs, inputs.heads, filmed, marks, reading, silent).rig,
        ]
        truth = film.person.head.rest[film.person.kind.dense]

        def error(head: BlendshapeRig, truth: Tensor = truth, places: Tensor = inputs.models.places) -> float:
            return apart(sites_on_rig(head, places).on(head.neutral.faces, head.vertices), truth)

        rows.append([error(head) for head in heads])
        print(f"{name:16s} mean head {rows[-1][0]:.2f}, of landmarks {rows[-1][1]:.2f}, of all {rows[-1][2]:.2f} mm")
    mean, landmarks, both = torch.tensor(rows).mean(0).tolist()
    print(f"all              mean head {mean:.2f}, of landmarks {landmarks:.2f}, of all {both:.2f} mm")
    assert both < landmarks
    assert both < mean
