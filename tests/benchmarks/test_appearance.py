"""Claim: on extreme faces an appearance model of fifteen annotated frames has at most 0.6 of the trees' error.

Three filmed performers, each with fifteen frames to learn from and forty-five other mixtures of extreme upper and lower
faces at 0.75 to 1 of their strength; heads turn up to 8 degrees and sway before a spotted wall. The trees are those of
the zoo, given boxes round the true landmarks, and everything else starts from what they say. Errors are mean distances
of the 68 landmarks, of the distance between the eyes' outer corners. Peers, from the same fifteen frames:

* optical flow (pyramids of Lucas and Kanade, OpenCV) of every landmark from the most similar annotated frame;
* menpofit's appearance models by the Wiberg inverse compositional algorithm, an exact solver of the same problem, where
  ``pip install --no-deps menpo menpofit`` has been run (names that newer SciPy and NumPy dropped are given back to it).

A real clip has no truth: there the model learns fifteen frames of what MediaPipe finds, and is measured against what it
finds in the others.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from real_faces import clips
from torch import Tensor

from planted.portrait_video import EXPRESSIONS, expression_weights, mixed_expressions, render_portrait_video
from torchface import zoo
from torchface.landmarks import AppearanceModel, AppearanceSettings
from torchface.landmarks.images.appearance.shape_modes import planar_pose
from torchface.landmarks.images.box_landmarks import appearance_landmarks
from torchface.landmarks.images.boxes.face_box import grey_pixels
from torchface.landmarks.images.ibug_68 import box_around
from torchface.synthetic import draw_identities, performer

LEARNED, TESTED, ACTORS = len(EXPRESSIONS), 45, (3, 4, 5)
BOUND = 0.6


@dataclass(frozen=True, eq=False)
class Scene:
    """An actor's frames (T,H,W) uint8 and landmarks (T,68,2), and where the trees see those of the tested frames."""

    frames: Tensor
    landmarks: Tensor
    start: Tensor

    @property
    def images(self) -> Tensor:
        return self.frames[LEARNED:, None].float() / 255

    @property
    def truth(self) -> Tensor:
        return self.landmarks[LEARNED:]


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    trees = zoo.get_model("face_landmarks")
    found = []
    for seed in ACTORS:
        generator = torch.Generator().manual_seed(seed)
        rig = performer(draw_identities(1, generator)[0])
        learned = expression_weights(rig.names, list(EXPRESSIONS.values()))
        weights = torch.cat([learned, mixed_expressions(rig.names, TESTED, generator)])
        film = render_portrait_video(rig, weights, generator)
        truth = film.landmarks[LEARNED:]
        with torch.no_grad():
            start = trees(film.frames[LEARNED:, None].float() / 255, box_around(truth))
        found.append(Scene(film.frames, film.landmarks, start))
    return found


def errors(found: Tensor, truth: Tensor, rows: slice = slice(None)) -> Tensor:
    return (found - truth)[:, rows].norm(dim=2).mean(1) / (truth[:, 36] - truth[:, 45]).norm(dim=1)


def fitted(scene: Scene, settings: AppearanceSettings) -> Tensor:
    model = AppearanceModel.fit(list(scene.frames[:LEARNED]), scene.landmarks[:LEARNED], settings)
    # One face a call, as a tracker does.
    rows = zip(scene.images, scene.start, strict=True)
    return torch.cat([model(image[None], start[None]) for image, start in rows])


def optical_flow(scene: Scene) -> Tensor:
    """Landmarks of the annotated frame that is most like the start, followed into the tested one."""
    known, found = scene.landmarks[:LEARNED], []
    for image, start in zip(scene.frames[LEARNED:], scene.start, strict=True):
        laid = torch.stack([planar_pose(one - one.mean(0), start[None]).apply(one - one.mean(0))[0] for one in known])
        nearest = int((laid - start).norm(dim=2).mean(1).argmin())
        middle = known[nearest].mean(0)
        pose = planar_pose(known[nearest] - middle, start[None])
        turn, centre = pose.rotation[0], torch.view_as_real(pose.translation)[0]
        matrix = np.array([[turn.real, -turn.imag, 0], [turn.imag, turn.real, 0]])
        matrix[:, 2] = centre.numpy() - matrix[:, :2] @ middle.numpy()
        height, width = image.shape
        before = cv2.warpAffine(scene.frames[nearest].numpy(), matrix, (width, height))
        places = laid[nearest].numpy()[:, None].copy()
        flow, seen, _ = cv2.calcOpticalFlowPyrLK(before, image.numpy(), places, places.copy(), winSize=(21, 21),
                                                 maxLevel=2, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)  # fmt: skip
        found.append(torch.from_numpy(np.where(seen[..., None] > 0, flow, places)[:, 0]))
    return torch.stack(found)


def menpofit_fitters() -> dict[str, Callable[[Scene], Tensor]]:
    """Holistic models of grey values and of gradient directions; none where menpofit is not installed."""
    import scipy.integrate

    shims: list[tuple[Any, str, Any]] = [
        (scipy.integrate, "simps", scipy.integrate.simpson),
        (np, "Inf", np.inf),
        (np, "product", np.prod),
    ]
    for module, name, value in shims:
        if not hasattr(module, name):
            setattr(module, name, value)
    try:
        from menpo.feature import igo, no_op
        from menpo.image import Image
        from menpo.shape import PointCloud
        from menpofit.aam import HolisticAAM, LucasKanadeAAMFitter, WibergInverseCompositional
    except ImportError as error:
        print(f"menpofit is left out: {error}")
        return {}

    def image(frame: Tensor) -> Any:
        return Image(frame.numpy()[None].astype(float) / 255)

    def fit(scene: Scene, features: Any) -> Tensor:
        known = [image(frame) for frame in scene.frames[:LEARNED]]
        for one, points in zip(known, scene.landmarks[:LEARNED], strict=True):
            one.landmarks["PTS"] = PointCloud(points.double().numpy()[:, ::-1].copy())
        model = HolisticAAM(known, group="PTS", diagonal=150, scales=(0.5, 1.0), holistic_features=features)
        fitter = LucasKanadeAAMFitter(
            model, lk_algorithm_cls=WibergInverseCompositional, n_shape=0.98, n_appearance=0.98
        )
        found = []
        for frame, start in zip(scene.frames[LEARNED:], scene.start, strict=True):
            begin = PointCloud(start.double().numpy()[:, ::-1].copy())
            result = fitter.fit_from_shape(image(frame), begin, max_iters=[20, 20])
            found.append(torch.from_numpy(result.final_shape.points[:, ::-1].copy()).float())
        return torch.stack(found)

    return {
        "menpofit, grey values": lambda scene: fit(scene, no_op),
        "menpofit, gradient directions": lambda scene: fit(scene, igo),
    }


def table(scenes: list[Scene], ways: dict[str, Callable[[Scene], Tensor]]) -> dict[str, float]:
    """Prints errors and costs, and gives the mean error of each way."""
    inner = slice(17, 68)
    truth = torch.cat([scene.truth for scene in scenes])
    base = errors(torch.cat([scene.start for scene in scenes]), truth)
    print(f"\n{'':36} {'mean':>7} {'of trees':>9} {'worst':>7} {'no jaw':>7} {'ms a face':>10}")
    print(f"{'landmark trees':36} {base.mean():7.4f} {1.0:9.2f} {base.max():7.4f}")
    means = {"landmark trees": float(base.mean())}
    for name, way in ways.items():
        begin = time.process_time()
        found = torch.cat([way(scene) for scene in scenes])
        cost = 1e3 * (time.process_time() - begin) / len(found)
        error, best = errors(found, truth), errors(found, truth, inner)
        means[name] = float(error.mean())
        print(
            f"{name:36} {error.mean():7.4f} {error.mean() / base.mean():9.2f} {error.max():7.4f} {best.mean():7.4f} "
            f"{cost:10.1f}"
        )
    return means


def test_fifteen_frames_leave_at_most_six_tenths_of_the_trees_error(scenes: list[Scene]) -> None:
    ways = {
        "appearance model": lambda scene: fitted(scene, AppearanceSettings()),
        "optical flow from the nearest frame": optical_flow,
        **menpofit_fitters(),
    }
    means = table(scenes, ways)
    ours = means.pop("appearance model")
    assert ours <= BOUND * means["landmark trees"]
    assert all(ours < other for other in means.values())


@pytest.mark.real
def test_fifteen_frames_of_a_real_clip(data: Path, one_thread: None) -> None:
    """From the trees' start, in boxes round the reference; the quickest frame of each, one after the other."""
    clip = next(one for one in clips(data) if one.name == "single_face")
    grey = [torch.from_numpy(grey_pixels(frame)) for frame in clip.frames]
    learned = torch.linspace(0, len(grey) - 1, LEARNED).round().long().tolist()
    tested = [number for number in range(len(grey)) if number not in learned]
    model = AppearanceModel.fit([grey[number] for number in learned], clip.reference[learned])
    trees, starts, found, spent = zoo.get_model("face_landmarks"), [], [], []
    for number in tested:
        box = box_around(clip.reference[number])[None]
        begin = time.process_time()
        with torch.no_grad():
            starts.append(trees(grey[number][None, None].float() / 255, box)[0])
        between = time.process_time()
        found.append(appearance_landmarks(model, grey[number], starts[-1]))
        spent.append((between - begin, time.process_time() - between))
    truth = clip.reference[tested]
    before, after = (errors(torch.stack(one), truth) for one in (starts, found))
    finder, refined = (1e3 * min(one) for one in zip(*spent, strict=True))
    print(
        f"\nsingle_face, {len(tested)} other frames: start {before.mean():.2%}, appearance model {after.mean():.2%} "
        f"from the reference, worst {after.max():.2%}; {refined:.1f} ms a frame, {refined / finder:.2f} of the trees'"
    )
    assert after.mean() < 0.0045
    assert after.max() < 0.015
