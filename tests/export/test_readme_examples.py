"""What export/README.md shows runs: Python with onnxruntime, JavaScript with onnxruntime-web under Node."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver, VideoSolver
from torchface.enhancement.wrinkle_maps.wrinkle_weights import RigWrinkles, WrinkleWeights
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.landmarks import DetectorSettings, LandmarkTrees, TreeSettings, UVLandmarkDetector
from torchface.landmarks.scans.hog import HogLayout
from torchface.modeling import ExpressionRegression, HeadModel, MorphableModel
from torchface.onnx import export_model, export_video_solver, export_wrinkle_weights
from torchface.onnx.video_graph_export import synthetic_landmarks
from torchface.synthetic import performer
from torchface.workflows.webcam.webcam_graph import webcam_graph
from train.rendered_people.webcam_video import talking_subject

EXPORT = Path(__file__).resolve().parents[2] / "export"
WEB = EXPORT / "web"
SIZE = 64


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def blocks(language: str) -> dict[str, str]:
    """The code of this language under each heading."""
    sections = (EXPORT / "README.md").read_text().split("\n## ")[1:]
    found = {}
    for section in sections:
        (code,) = re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL)
        found[section.splitlines()[0]] = code
    return found


@pytest.fixture(scope="module")
def folder(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every graph and input that the examples open."""
    path = tmp_path_factory.mktemp("graphs")
    vertices = dome_rig.vertices
    people = vertices + noise(6, *vertices.shape)
    head = HeadModel.on(dome_rig.neutral, MorphableModel.fit(people), MorphableModel.fit(0.5 + 0.1 * people / 50))
    offsets = dome_rig.deltas * (1 + 0.3 * noise(6, 4, 1, 1))
    regression = ExpressionRegression.fit(people, people[:, None] + offsets, names=dome_rig.names)
    solver = MarkerSolver(dome_rig, Attachment.from_vertices(dome_rig.neutral, range(0, 600, 9)))
    images = torch.rand(3, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    places = torch.tensor([[20.0, 20.0], [40.0, 44.0]]) + noise(3, 2, 2)
    settings = DetectorSettings(hog=HogLayout(stride=4), responses=50)
    detector = UVLandmarkDetector.fit(images, places, ("left", "right"), "curvature", settings)
    coarse = torch.rand(1, 1, 12, 20)
    picture = (255 * torch.nn.functional.interpolate(coarse, (360, 640), mode="bilinear")[0, 0]).byte()
    box = torch.tensor([[220.0, 90, 180, 180]])
    few = TreeSettings(cascades=2, trees=4, depth=2, oversampling=4, components=4)
    trees = LandmarkTrees.fit([picture], box, 220 + 100 * torch.rand(1, 68, 2), few)
    (path / "picture.gray").write_bytes(picture.numpy().tobytes())
    np.save(path / "picture.npy", picture.numpy())
    models = {"head": head, "expressions": regression, "uv_landmarks": detector, "face_landmarks": trees}
    for name, model in {**models, "solver": solver}.items():
        export_model(model, path / f"{name}.onnx")
    markers = solver.rest + solver.basis[..., 0] * torch.linspace(0, 1, 5)[:, None, None]
    markers[2, 3] = torch.nan
    person = performer(texture=False).select(["jawOpen", "mouthSmileLeft", "browInnerUp"])
    camera = assumed_calibration(640, 480)
    export_video_solver(person, camera, path / "video_solver.onnx")
    (path / "webcam.onnx").write_bytes(webcam_graph())
    poses = torch.rand(12, 3, generator=torch.Generator().manual_seed(2))
    regions = torch.ones(1, len(person.vertices))
    wrinkles = WrinkleWeights.fit(person.vertices, person(poses), poses[:, None], regions, ["face"], components=4)
    export_wrinkle_weights(RigWrinkles(wrinkles, person), poses, path / "map_weights.onnx")
    film(path)
    marks = synthetic_landmarks(VideoSolver(person, None, camera.intrinsics), 5)[1]
    inputs = {"neutral": people[0], "image": images[0], "markers": markers, "landmarks": marks}
    for name, values in inputs.items():
        array = values.numpy().astype(np.float32)
        np.save(path / f"{name}.npy", array)
        (path / f"{name}.f32").write_bytes(array.tobytes())
    return path


def film(path: Path) -> None:
    """A face before a webcam, as a file without loss and as the pixels of a canvas."""
    frames = talking_subject(6)
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path / "webcam.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 30.0, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    camera, canvas = cv2.VideoCapture(str(path / "webcam.avi")), b""
    for _ in frames:
        canvas += cv2.cvtColor(camera.read()[1], cv2.COLOR_BGR2RGBA).tobytes()
    (path / "webcam.rgba").write_bytes(canvas)


@pytest.fixture(scope="module")
def node() -> str:
    """The path of node, with onnxruntime-web installed in export/web; kept there for the next run."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed; onnxruntime-web comes from npm")
    mark = WEB / "node_modules" / ".torchface-lock.json"
    wanted = (WEB / "package-lock.json").read_text()
    if not mark.is_file() or mark.read_text() != wanted:
        done = subprocess.run(
            [npm, "ci", "--no-audit", "--no-fund", "--ignore-scripts"],
            cwd=WEB,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        if done.returncode != 0:
            pytest.skip(f"npm could not install onnxruntime-web: {done.stderr[-300:]}")
        mark.write_text(wanted)
    return node


RESULTS = {
    "A head from coefficients": "vertices",
    "A rig from a neutral face": "offsets",
    "Landmarks of an unwrapped head": "pixels",
    "Landmarks of faces in a picture": "landmarks",
    "Weights from markers": "previous",
    "Weights from landmarks in a video": "weights",
    "From a webcam's picture to weights": "weights",
    "Wrinkle maps in an engine": "map_weights",
}


@pytest.fixture(scope="module")
def in_python(folder: Path) -> dict[str, np.ndarray]:
    """What each example in Python computes, by its heading."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for title, name in RESULTS.items():
            names: dict = {}
            exec(compile(blocks("python")[title], f"{title} in README.md", "exec"), names)
            found[title] = np.asarray(names[name])
    return found


@pytest.mark.bench
def test_python_runs(in_python: dict[str, np.ndarray]) -> None:
    assert set(blocks("python")) == set(blocks("js")) == set(RESULTS)
    for title, values in in_python.items():
        assert np.isfinite(values).all(), title


@pytest.mark.bench
@pytest.mark.browser
def test_javascript_computes_the_same(folder: Path, node: str, in_python: dict[str, np.ndarray]) -> None:
    """Each example is a module of its own; one node imports them one after the other."""
    (folder / "node_modules").symlink_to(WEB / "node_modules")
    for number, (title, name) in enumerate(RESULTS.items()):
        code = blocks("js")[title] + f"\nconsole.log('result ' + JSON.stringify(Array.from({name}.data)));\n"
        (folder / f"example_{number}.mjs").write_text(code)
    imports = [f"await import('./example_{number}.mjs');\n" for number in range(len(RESULTS))]
    (folder / "examples.mjs").write_text("".join(imports))
    done = subprocess.run([node, "examples.mjs"], cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    results = [line.removeprefix("result ") for line in done.stdout.splitlines() if line.startswith("result ")]
    for (title, expected), found in zip(in_python.items(), results, strict=True):
        np.testing.assert_allclose(np.array(json.loads(found)), expected.ravel(), rtol=0, atol=2e-3, err_msg=title)
