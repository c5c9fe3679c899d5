"""JSON recordings: Audio2Face's 52 and 16 of the tongue, ARKit's face anchors, and MediaPipe's blendshapes."""

import json
from pathlib import Path

import pytest
import torch
from mutation import check_reader
from recordings_of_phones import TONGUE, audio2face, face_anchors, mediapipe, some_frames

from torchface import load_take
from torchface.errors import FileFormatError
from torchface.io.weights.json_recordings import is_weight_json, load_weight_json
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT, mapping


def test_audio2faces_shapes_and_those_of_the_tongue_come_by_name(tmp_path: Path) -> None:
    weights, _ = some_frames()
    tongue = torch.rand(5, 16, generator=torch.Generator().manual_seed(1))
    take = load_take(audio2face(tmp_path / "take.json", weights, tongue))
    assert take.fps == 30
    assert take.weights.names[52:] == tuple(name[0].upper() + name[1:] for name in TONGUE)
    torch.testing.assert_close(take.weights.values[:, 52:, 0], tongue)
    torch.testing.assert_close(take.weights.values[..., 0] @ mapping(take.weights.names, ARKIT).T, weights)


def test_face_anchors_keep_weights_rotations_and_times(tmp_path: Path) -> None:
    weights, rotations = some_frames()
    take = load_take(face_anchors(tmp_path / "take.json", weights, rotations))
    torch.testing.assert_close(take.weights.values[..., 0], weights)
    found = torch.stack([take.extras["columns"][name] for name in ROTATIONS], 1)
    torch.testing.assert_close(found.float(), rotations, atol=1e-5, rtol=0)
    assert take.fps == 60
    (tmp_path / "list.json").write_text(json.dumps(json.loads((tmp_path / "take.json").read_text())["frames"]))
    assert load_take(tmp_path / "list.json").extras.keys() == take.extras.keys()


@pytest.mark.parametrize("javascript", [False, True])
@pytest.mark.filterwarnings("ignore:.*milliseconds")
def test_mediapipes_blendshapes_keep_weights_times_and_frames_without_a_face(tmp_path: Path, javascript: bool) -> None:
    weights, _ = some_frames()
    path = mediapipe(tmp_path / "take.json", weights, javascript)
    frames = json.loads(path.read_text())
    frames[2]["faceBlendshapes" if javascript else "face_blendshapes"] = []
    path.write_text(json.dumps(frames))
    assert is_weight_json(path)
    take = load_take(path)
    assert take.fps == 25
    assert take.weights.names == tuple(name for name in ARKIT if name != "tongueOut")
    expected = weights[:, [name != "tongueOut" for name in ARKIT]]
    expected[2] = torch.nan
    torch.testing.assert_close(take.weights.values[..., 0], expected, equal_nan=True)


def test_categories_alone_are_read_at_30_frames_a_second(tmp_path: Path) -> None:
    weights, _ = some_frames()
    frames = json.loads(mediapipe(tmp_path / "take.json", weights).read_text())
    frames[0]["facial_transformation_matrixes"] = [[[1, 0, 0, 0]] * 4]
    (tmp_path / "matrix.json").write_text(json.dumps(frames))
    with pytest.warns(UserWarning, match=r"matrix\.json: the head's motion .* is not read"):
        load_take(tmp_path / "matrix.json")
    (tmp_path / "bare.json").write_text(json.dumps([frame["face_blendshapes"][0] for frame in frames]))
    with pytest.warns(UserWarning, match=r"bare\.json: found no timestamp in its frames; 30 a second are taken"):
        take = load_take(tmp_path / "bare.json")
    assert (take.fps, len(take)) == (30, 5)
    (tmp_path / "one.json").write_text(json.dumps(frames[0]["face_blendshapes"][0]))
    assert is_weight_json(tmp_path / "one.json")
    with pytest.warns(UserWarning, match=r"one\.json: found no timestamp"):
        one = load_take(tmp_path / "one.json")
    torch.testing.assert_close(one.weights.values, take.weights.values[:1])


@pytest.mark.parametrize(
    ("document", "found"),
    [
        ({}, "expected Audio2Face's facsNames and weightMat, or a list of frames"),
        ([], "expected Audio2Face's"),
        (
            {"weightMat": [[1.0]], "facsNames": ["a", "b"], "exportFps": 30},
            r"weightMat = \[\[1.0\]\], expected rows of 2",
        ),
        ({"weightMat": [], "facsNames": ["a"], "exportFps": 30}, "expected a frame at least"),
        ({"weightMat": [[1.0]], "facsNames": ["a"], "exportFps": 0}, "exportFps"),
        ({"weightMat": [[1.0]], "facsNames": ["a", "a"], "exportFps": 30}, "expected 1 to 1000 names, each once"),
        ([{"blendShapes": {"wing": 1}, "timestamp": 0}], "expected some of ARKit's 52"),
        ([{"blendShapes": {"jawOpen": "wide"}, "timestamp": 0}], "jawOpen = 'wide', expected a weight"),
        ([{"blendShapes": {"jawOpen": 1}}], "expected seconds"),
        ([{"blendShapes": {"jawOpen": 1}, "timestamp": 0, "transform": [1]}], "expected 16 numbers"),
        ([{"blendShapes": {"jawOpen": 1}, "timestamp": 0}, {"blendShapes": {}, "timestamp": 1}], "of the first frame"),
        ([5], "expected a table"),
        ([[{"category_name": "wing", "score": 1}]], "expected a category with one of ARKit's names and a score"),
        ([[{"category_name": "jawOpen", "score": "wide"}]], "score = 'wide', expected a score"),
        ([[{"category_name": "jawOpen", "score": 1}], 5], "expected MediaPipe's categories"),
        ([{"faceBlendshapes": []}] * 3, "found no face in any of 3 frames, expected MediaPipe's"),
        ([[{"category_name": "_neutral", "score": 1}]], "found no category but _neutral, expected MediaPipe's"),
    ],
)
def test_what_is_no_recording_is_refused(document: object, found: str, tmp_path: Path) -> None:
    (tmp_path / "take.json").write_text(json.dumps(document))
    with pytest.raises(FileFormatError, match=rf"take\.json: .*{found}"):
        load_weight_json(tmp_path / "take.json")


def test_other_documents_are_told_apart(tmp_path: Path) -> None:
    weights, rotations = some_frames()
    assert is_weight_json(face_anchors(tmp_path / "a.json", weights, rotations))
    assert is_weight_json(audio2face(tmp_path / "b.json", weights, weights[:, :16]))
    (tmp_path / "c.json").write_text('{"format": "torchface.attachment/1", "frames": [1]}')
    assert not is_weight_json(tmp_path / "c.json")


def test_a_mutated_recording_is_read_or_refused(tmp_path: Path) -> None:
    weights, rotations = some_frames(2)
    seeds = [
        face_anchors(tmp_path / "a.json", weights, rotations),
        audio2face(tmp_path / "b.json", weights, weights[:, :16]),
        mediapipe(tmp_path / "c.json", weights),
    ]
    check_reader(load_take, seeds, ".json")
