"""A video's weights by example expressions: the dissertation's three methods side by side, the solved one drawn."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from torchface.capture.anybody import AllAtOnce, ExampleShapes, ExampleSolver, LandmarkModel, Regional, SolvedSimilarity
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.files.whole_files import all_or_none
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_take
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.io.tables.csv_table import write_table
from torchface.io.video import VideoFile, open_video, write_video
from torchface.io.weights.weight_csv import save_weights_csv
from torchface.landmarks import LandmarkTracker
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.images.tracking.video_landmarks import track_landmarks
from torchface.progress import Progress, silent
from torchface.take import Take, Track
from torchface.viz.figures.landmark_dots import with_dots
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder

Method = Literal["all", "regional", "linear"]
METHODS: tuple[Method, ...] = ("all", "regional", "linear")
WEIGHTS, LANDMARKS, TABLE, OVERLAY = "weights.csv", "landmarks.csv", "methods.csv", "overlay.mp4"
_EYES = (36, 45)


@dataclass(frozen=True)
class MethodFigures:
    """What a method costs and how near it comes on one video."""

    # All shapes at once with size, roll and place; the head first and then regions; or by a linear model.
    method: Method
    pixels: float  # mean distance of the landmarks
    share: float  # the same, of the distance of the eyes' outer corners
    milliseconds: float  # a frame, solved one after the other from the frame before, mean


@dataclass(frozen=True, eq=False)
class ExampleTake:
    """What came of a video."""

    weights: Tensor  # of the examples, (T,N); NaN where no face was found
    solved: Tensor  # where the chosen method puts the landmarks, (T,68,2)
    figures: tuple[MethodFigures, ...]  # one for each method
    products: dict[str, Path]


def averaged_examples(people: Sequence[ExampleShapes]) -> ExampleShapes:
    """The mean of several people's examples, each moved onto the first's neutral by a similarity."""
    first = people[0]
    rows = []
    for one in people:
        if set(one.names) != set(first.names):
            raise NameMismatchError(
                f"examples: found {', '.join(sorted(set(one.names) ^ set(first.names))[:5])} of some people alone, "
                "expected the same expressions of all"
            )
        chosen = one.select(first.names)
        flat = torch.nn.functional.pad(torch.cat([chosen.neutral[None], chosen.landmarks]).double(), (0, 1))
        target = torch.nn.functional.pad(first.neutral.double(), (0, 1))
        pose = similarity_transform(flat[:1], target[None])
        rows.append(pose.apply(flat.flatten(0, 1)[None])[0].view_as(flat)[..., :2])
    mean = torch.stack(rows).mean(0).float()
    return ExampleShapes(first.names, mean[0], mean[1:])


def example_solver(examples: ExampleShapes, method: Method) -> ExampleSolver:
    """The solver of a method, with the placement that comes nearest on people whom the examples do not show."""
    if method == "all":
        return ExampleSolver(examples, AllAtOnce(), SolvedSimilarity())
    return ExampleSolver(examples, Regional() if method == "regional" else LandmarkModel.fit(examples))


def solve_by_examples(
    examples: ExampleShapes, landmarks: Tensor, method: Method
) -> tuple[Tensor, Tensor, MethodFigures]:
    """Weights (T,N) and solved landmarks (T,68,2) of frames (T,68,2), one after the other, and how the method fared."""
    seen = torch.isfinite(landmarks).all(2).all(1).nonzero()[:, 0]
    if not len(seen):
        raise ValueRangeError("landmarks: found no frame with all 68, expected a face")
    solver = example_solver(examples, method)
    weights = landmarks.new_full((len(landmarks), len(examples.names)), torch.nan)
    solved, before = torch.full_like(landmarks, torch.nan), None
    began = time.process_time()
    with torch.no_grad():
        for t in seen.tolist():  # each starts from the frame before, as before a camera
            fit = solver.fit(landmarks[t : t + 1], before)
            before = fit.weights
            weights[t], solved[t] = fit.weights[0], solver.landmarks(fit)[0]
    took = 1000 * (time.process_time() - began) / len(seen)
    off = (solved - landmarks)[seen].norm(dim=2).mean(1)
    eyes = (landmarks[seen, _EYES[0]] - landmarks[seen, _EYES[1]]).norm(dim=1)
    figures = MethodFigures(method, float(off.mean()), float((off / eyes).mean()), took)
    return weights, solved, figures


def track_by_examples(
    video: Path | None,
    examples: Sequence[Path],
    out: Path,
    method: Method = "all",
    landmarks: str = DEFAULT_LANDMARKS,
    face: int = 0,
    progress: Progress | None = None,
) -> ExampleTake:
    """Tracks a face and solves it by examples; all three methods are measured on it."""
    progress = progress or silent
    if not examples:
        raise ValueRangeError("track: found no examples, expected what `torchface examples` wrote (--examples)")
    shapes = averaged_examples([ExampleShapes.load(path) for path in examples])
    clip = None if video is None else open_video(video)
    take = _landmarks(clip, landmarks, face, progress)
    assert take.landmarks is not None
    if clip is not None and clip.count != len(take):
        raise ValueRangeError(f"{video}: found {clip.count} frames, expected the {len(take)} of the landmarks")
    marks, found = take.landmarks.values.double(), {}
    for one in METHODS:
        progress(f"solving: {one}")
        found[one] = solve_by_examples(shapes, marks, one)
    weights, solved, _ = found[method]
    figures = tuple(found[one][2] for one in METHODS)
    products = {"weights": out / WEIGHTS, "landmarks": out / LANDMARKS, "methods": out / TABLE}
    with all_or_none():
        track = Track(shapes.names, weights.float()[..., None])
        save_weights_csv(Take(take.fps, weights=track, seconds=take.seconds), products["weights"])
        save_landmarks_csv(take, products["landmarks"])
        rows = [[one.method, f"{one.pixels:.4g}", f"{one.share:.4g}", f"{one.milliseconds:.4g}"] for one in figures]
        write_table(products["methods"], ["method", "pixels", "of_the_eyes_distance", "ms_a_frame"], rows)
        if clip is not None:
            products["overlay"] = out / OVERLAY
            write_video(_drawn(clip, marks, solved, progress), products["overlay"], clip.fps)
    return ExampleTake(weights, solved, figures, products)


def _landmarks(clip: VideoFile | None, landmarks: str, face: int, progress: Progress) -> Take:
    if landmarks.lower().endswith(".csv"):
        take = load_take(Path(landmarks))
        if take.landmarks is None or len(take.landmarks.names) != COUNT:
            raise ValueRangeError(f"{landmarks}: found no {COUNT} landmarks over time, expected iBUG's")
        return take
    if clip is None:
        raise ValueRangeError("track: found neither VIDEO nor a .csv of landmarks, expected one")
    named = load_finder(landmarks, "film")
    tracker = LandmarkTracker(named.finder, face=face, fps=clip.fps)
    return Take(clip.fps, landmarks=track_landmarks(clip, tracker, progress))


def _drawn(clip: VideoFile, marks: Tensor, solved: Tensor, progress: Progress) -> Iterator[Tensor]:
    """Found landmarks green, the solved example's red."""
    for t, frame in enumerate(clip.color_frames()):
        yield with_dots(frame, marks[t], solved[t])[None]
        progress("drawing the video", t + 1, clip.count)
