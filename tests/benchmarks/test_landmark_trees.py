"""Claim: landmark trees learn rendered faces as well as dlib's shape predictor from the same pictures, boxes and
settings (within 5 %), and a model of 10 cascades of 500 trees takes at most 1.5 ms a face in ONNX Runtime."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.landmarks import LandmarkTrees, TreeSettings
from torchface.landmarks.images.ibug_68 import MIRROR_68, relative_errors
from torchface.onnx import export_model
from train.annotated_faces import Faces, load_faces, rendered_faces
from train.landmark_trees import evaluate

LEARN, TEST = 300, 150
SETTINGS = TreeSettings(cascades=8, trees=60, depth=5, oversampling=10, rotation=0, gamma=0, noise=0)
# dlib counts whole pixels, in what it learns and in what it says: large pictures make that no handicap.
LARGER = 3


@pytest.fixture(scope="module")
def faces() -> tuple[Faces, Faces]:
    return enlarged(rendered_faces(LEARN, 21)), jittered(enlarged(rendered_faces(TEST, 22)), 1)


def enlarged(faces: Faces) -> Faces:
    images = [
        torch.from_numpy(cv2.resize(image.numpy(), None, fx=LARGER, fy=LARGER, interpolation=cv2.INTER_CUBIC))
        for image in faces.images
    ]
    return Faces(images, (LARGER * faces.boxes).round(), (LARGER * (faces.landmarks + 0.5) - 0.5).round(), faces.people)


def jittered(faces: Faces, seed: int) -> Faces:
    """Boxes moved and sized as a detector does, and as training does."""
    drawn = torch.randn(len(faces), 3, generator=torch.Generator().manual_seed(seed)).clamp(-2.5, 2.5)
    side = faces.boxes[:, 2:] * (SETTINGS.scale * drawn[:, 2:]).exp()
    middle = faces.boxes[:, :2] + faces.boxes[:, 2:] * (0.5 + SETTINGS.translation * drawn[:, :2])
    return replace(faces, boxes=torch.cat([middle - side / 2, side], dim=1).round())


def mirrored(faces: Faces) -> Faces:
    wide = torch.tensor([image.shape[1] - 1.0 for image in faces.images])
    landmarks, boxes = faces.landmarks[:, list(MIRROR_68)].clone(), faces.boxes.clone()
    landmarks[..., 0] = wide[:, None] - landmarks[..., 0]
    boxes[:, 0] = wide - boxes[:, 0] - boxes[:, 2]
    return Faces([image.flip(1).contiguous() for image in faces.images], boxes, landmarks, faces.people)


def cpu_milliseconds(run: Callable[[int], object], count: int) -> float:
    spent = []
    for number in range(count):
        begin = time.process_time()
        run(number)
        spent.append(time.process_time() - begin)
    return 1000 * float(np.median(spent))


def test_error_beside_dlib(faces: tuple[Faces, Faces], tmp_path: Path) -> None:
    learn, test = faces
    begin = time.process_time()
    model = LandmarkTrees.fit(learn.images, learn.boxes, learn.landmarks, SETTINGS)
    seconds = time.process_time() - begin
    export_model(model, tmp_path / "trees.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(tmp_path / "trees.onnx", options)

    def ours(number: int) -> np.ndarray:
        inputs = {"image": test.images[number].numpy(), "boxes": test.boxes[number : number + 1].numpy()}
        return session.run(None, inputs)[0][0]

    found = torch.from_numpy(np.stack([ours(number) for number in range(len(test))]))
    error = relative_errors(found, test.landmarks)
    print(f"\n{LEARN} rendered faces to learn from, {TEST} of other people to test on, {SETTINGS}")
    print(f"  torchface: mean error {100 * error.mean():.2f} %, median {100 * error.median():.2f} %, "
          f"learned in {seconds:.0f} s, {cpu_milliseconds(ours, len(test)):.2f} ms a face")  # fmt: skip
    try:
        import dlib
    except ImportError:
        pytest.skip("dlib is not installed: no comparison was made (pip install '.[bench-dlib]')")
    peers = []
    for name in ("dlib, the same perturbed boxes", "dlib, its own oversampling"):
        begin = time.process_time()
        predictor = learned_by_dlib(dlib, learn, own_oversampling="own" in name)
        seconds = time.process_time() - begin

        def theirs(number: int, predictor: object = predictor) -> np.ndarray:
            shape = predictor(test.images[number].numpy(), rectangle(dlib, test.boxes[number]))
            return np.array([[part.x, part.y] for part in shape.parts()], dtype=np.float32)

        found = torch.from_numpy(np.stack([theirs(number) for number in range(len(test))]))
        peer = relative_errors(found, test.landmarks)
        peers.append(float(peer.mean()))
        print(f"  {name}: mean error {100 * peer.mean():.2f} %, median {100 * peer.median():.2f} %, "
              f"learned in {seconds:.0f} s, {cpu_milliseconds(theirs, len(test)):.2f} ms a face")  # fmt: skip
    assert float(error.mean()) <= 1.05 * min(peers)


def rectangle(dlib, box: Tensor):
    x, y, width, height = (int(value) for value in box)
    return dlib.rectangle(x, y, x + width - 1, y + height - 1)


def learned_by_dlib(dlib, learn: Faces, own_oversampling: bool):
    """dlib's trees of the same sizes, from the same pictures and their mirror images."""
    options = dlib.shape_predictor_training_options()
    options.cascade_depth, options.num_trees_per_cascade_level = SETTINGS.cascades, SETTINGS.trees
    options.tree_depth, options.nu = SETTINGS.depth, SETTINGS.shrinkage
    options.feature_pool_size, options.num_test_splits = SETTINGS.features, SETTINGS.test_splits
    options.feature_pool_region_padding, options.lambda_param = SETTINGS.padding, SETTINGS.closeness
    options.num_threads, options.be_verbose, options.random_seed = 1, False, "0"
    each = SETTINGS.oversampling // 2  # starts a picture, and as many of its mirror image
    options.oversampling_amount = each if own_oversampling else 1
    options.oversampling_translation_jitter = SETTINGS.translation if own_oversampling else 0.0
    images, detections = [], []
    for side in (learn, mirrored(learn)):
        boxes = [side.boxes] if own_oversampling else [jittered(side, 10 + turn).boxes for turn in range(each)]
        for number, image in enumerate(side.images):
            points = [dlib.point(int(x), int(y)) for x, y in side.landmarks[number].tolist()]
            images.append(image.numpy())
            detections.append([dlib.full_object_detection(rectangle(dlib, box[number]), points) for box in boxes])
    return dlib.train_shape_predictor(images, detections, options)


@pytest.mark.real
def test_photographs(data: Path) -> None:
    """18 faces of four photographs: the shipped trees, and trees learned from the other three photographs alone.

    The landmarks are those of dlib's own predictor: a reference to agree with, not the truth.
    """
    path = data / "images" / "dlib_faces" / "training_with_face_landmarks.xml"
    faces = load_faces(path)
    pictures = [face.image for face in load_dlib_faces(path)]
    shipped = float(evaluate(zoo.get_model("face_landmarks"), faces).mean())
    print(f"\nbeside dlib's predictor, shipped: mean difference {100 * shipped:.1f} %")
    settings = TreeSettings(cascades=8, trees=60, oversampling=150, components=20)
    errors = []
    for picture in sorted(set(pictures)):
        learn, test = (
            faces.some(rows)
            for rows in (
                [row for row, name in enumerate(pictures) if name != picture],
                [row for row, name in enumerate(pictures) if name == picture],
            )
        )
        errors.append(evaluate(LandmarkTrees.fit(learn.images, learn.boxes, learn.landmarks, settings), test))
        print(f"  {picture}, learned from the others: {100 * errors[-1].mean():.1f} %")
    print(f"learned from photographs: mean difference {100 * torch.cat(errors).mean():.1f} %")
    assert torch.cat(errors).mean() < 0.1
