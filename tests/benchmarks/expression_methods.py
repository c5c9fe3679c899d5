"""What turns a film into weights of ARKit's shapes, each by its own means, and writes them as Live Link Face does."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from planted.mediapipe_tracker import MediaPipeTracker
from torchface import BlendshapeRig, Take, Track, load_take, save_rig
from torchface.capture import ExampleSolver, WebcamControls
from torchface.capture.anybody import AllAtOnce, character_matrix, paper_examples
from torchface.io import load_ict_facekit, save_live_link
from torchface.io.video import open_video
from torchface.landmarks.images.face_mesh_478 import landmarks_of_mesh
from torchface.progress import silent
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer
from torchface.workflows.live.live_anybody import person_solver
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_video import track_video
from train.rendered_people.people import Person
from train.rendered_people.webcam_film import Film


@dataclass(frozen=True)
class Clip:
    """A video without truth."""

    path: Path


Method = Callable[[Film | Clip], tuple[Tensor, Tensor]]
"""Gives weights (T,52) of a film, NaN where a face is lost or a shape not known, and iBUG's landmarks (T,68,2)."""


def frames(film: Film | Clip) -> Iterator[Tensor]:
    """Pictures, uint8 (3,H,W)."""
    return replace(open_video(film.path), even=False).color_frames()


def mediapipe(bundle: Path) -> Method:
    """MediaPipe's blendshapes, as they are."""

    def run(film: Film | Clip) -> tuple[Tensor, Tensor]:
        tracker = MediaPipeTracker(bundle)
        faces = [tracker.mesh(frame) for frame in frames(film)]
        lost = torch.full((len(ARKIT),), torch.nan), torch.full((68, 2), torch.nan)
        found = [
            lost if face is None else (tracker.landmarker.blendshapes(face.points), landmarks_of_mesh(face.points))
            for face in faces
        ]
        return torch.stack([weights for weights, _ in found]), torch.stack([marks for _, marks in found])

    return run


def live(film: Film | Clip) -> tuple[Tensor, Tensor]:
    """``torchface live`` with nobody to calibrate it."""
    solver = _live()
    weights, marks = [], []
    for number, frame in enumerate(frames(film)):
        picture = np.ascontiguousarray(frame.permute(1, 2, 0).numpy())
        solved = solver.step(picture, None if number == 0 else 1 / 30, WebcamControls(reset=number == 0))
        weights.append(torch.as_tensor(solved.weights).clone())
        marks.append(torch.as_tensor(solved.landmarks).clone())
    return torch.stack(weights) @ mapping(solver.names, ARKIT).T, torch.stack(marks)


@lru_cache(maxsize=1)
def _live():
    return person_solver(silent)


def track(rig: Callable[[Film | Clip], BlendshapeRig] | None, **options: object) -> Method:
    """``torchface track`` on a rig, or on the head that it solves with the film."""

    def run(film: Film | Clip) -> tuple[Tensor, Tensor]:
        with TemporaryDirectory() as folder:
            path = None if rig is None else Path(folder) / "rig.glb"
            if rig is not None and path is not None:
                save_rig(rig(film), path)
            settings = TrackSettings(overlay="none", **options)
            tracked = track_video(film.path, path, Path(folder) / "out", settings)
            weights = load_take(Path(folder) / "out" / "live_link.csv").weights
            return weights.values[..., 0].float() @ mapping(weights.names, ARKIT).T, tracked.reading.landmarks

    return run


def mean_head(film: Film | Clip) -> BlendshapeRig:
    """The embedded performer's mean head, whoever is filmed."""
    return performer(texture=False)


def own_head(ict: Path) -> Callable[[Film | Clip], BlendshapeRig]:
    """The rig of whom a film shows."""

    def rig(film: Film | Clip) -> BlendshapeRig:
        assert isinstance(film, Film)
        return person_rig(film.person, ict)

    return rig


def person_rig(person: Person, ict: Path) -> BlendshapeRig:
    """Someone's true rig: the face alone of ICT-FaceKit's heads."""
    own = performer(texture=False)
    if len(person.head.rest) != len(own.vertices):
        own = load_ict_facekit(ict)
    notes = own.neutral.annotations
    rig = BlendshapeRig(own.neutral.with_vertices(person.head.rest), person.head.deltas, own.names)
    return rig.part(notes.regions["face"]) if "face" in notes.regions and len(rig.vertices) > 20_000 else rig


def examples(reference: Callable[[Film | Clip], Tensor]) -> Method:
    """The dissertation's solver on 16 examples of the embedded performer, for landmarks that another method found."""

    def run(film: Film | Clip) -> tuple[Tensor, Tensor]:
        shown = paper_examples(performer(texture=False))
        solver, onto = ExampleSolver(shown, AllAtOnce()), character_matrix(shown.names, ARKIT)
        landmarks, before, rows = reference(film), None, []
        for marks in landmarks:  # a frame starts where the one before ended
            if bool(torch.isfinite(marks).all()):
                before = solver(marks[None], before)
            rows.append(torch.zeros(len(shown.names)) if before is None else before[0])
        return (torch.stack(rows) @ onto.T).clamp(0, 1), landmarks

    return run


def run_methods(
    methods: dict[str, Method], films: dict[str, Film], results: Path, say: Callable[[str], None] = print
) -> None:
    """Writes RESULTS/METHOD/FILM.csv of each method and film."""
    for name, method in methods.items():
        started = time.process_time()
        for film, shown in films.items():
            weights, _ = method(shown)
            folder = results / name
            folder.mkdir(parents=True, exist_ok=True)
            save_live_link(Take(30.0, weights=Track(ARKIT, weights[..., None].float())), folder / f"{film}.csv")
        say(f"{name}: {time.process_time() - started:.0f} s of processor time")
