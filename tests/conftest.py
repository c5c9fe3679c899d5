"""Real data, the order of tests and hypothesis, for all tests."""

from __future__ import annotations

import gc
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from compileall import compile_file
from contextlib import suppress
from copy import copy, deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from _pytest.assertion import rewrite
from hypothesis import settings
from hypothesis.internal.conjecture import providers

if TYPE_CHECKING:  # fixtures import what they need: the process that only hands out tests reads this file too
    import torch

    from torchface.attachment import Attachment
    from torchface.geometry.cameras.pinhole import Camera
    from torchface.mesh import Mesh
    from torchface.rig import BlendshapeRig

REPOSITORY = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("TORCHFACE_DATA", REPOSITORY.parent / "shared" / "data"))

gc.disable()  # until all tests are imported

settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True, max_examples=25)
settings.register_profile("dev", deadline=None, max_examples=25)
settings.load_profile("ci" if os.environ.get("CI") else "dev")
# Hypothesis reads the constants of all source for examples, five seconds a process; tests name their own edges.
# The names are private: where another version has others, it reads them.
if hasattr(providers, "_get_local_constants") and hasattr(providers, "_local_constants"):
    providers._get_local_constants = lambda: providers._local_constants


LONGEST = (
    "capture/action_units",
    "onnx",
    "test_packaging",
    "test_docstrings",
    "viz/browser",
    "workflows",
    "train",
    "export",
    "capture",
    "modules",
    "registration",
    "landmarks",
    "modeling",
    "io/gltf",
    "cli",
)
"""Where the longest tests lie, which go first: then the processes of a run end together."""


TOGETHER = {
    "browsers": (
        "export/web_app/test_app_in",
        "export/web_app/test_app_controls",
        "export/web_app/test_character_files",
        "io/gltf/test_gltf_browser",
        "io/vrm/test_vrm_in_browser",
        "viz/browser",
        "viz/reports/test_player",
        "workflows/live/test_page_in_chromium",
    ),
    "action units": ("capture/action_units", "train/test_action_units", "train/filmed_performers/test_camera_stage"),
}
"""Files for one process: two browsers take the time from one another, and a filmed session is costly to make twice."""


def pytest_configure(config: pytest.Config) -> None:
    """Ends the run where a list above names no test any more: it would quietly do nothing."""
    names = (*LONGEST, *(name for files in TOGETHER.values() for name in files))
    lost = [name for name in names if not any((REPOSITORY / "tests").glob(f"{name}*"))]
    if lost:
        raise pytest.UsageError(
            f"tests/conftest.py: found no tests at {', '.join(lost)}; expected LONGEST and TOGETHER true"
        )
    if hasattr(config, "workerinput") and not sys.dont_write_bytecode:
        given = config.workerinput
        _write_bytecode(config, int(given["workerid"].removeprefix("gw")), given["workercount"])


def _write_bytecode(config: pytest.Config, process: int, processes: int) -> None:
    """Writes a process's share of all bytecode: in a fresh clone each process would make all of it, ten seconds."""
    for path in [path for name in ("torchface", "train") for path in sorted((REPOSITORY / name).rglob("*.py"))][
        process::processes
    ]:
        compile_file(path, quiet=1)
    with suppress(AttributeError, TypeError):  # another pytest may have other names; each process then makes all of it
        for path in sorted((REPOSITORY / "tests").rglob("test_*.py"))[process::processes]:
            written = rewrite.get_cache_dir(path) / (path.stem + rewrite.PYC_TAIL)
            if rewrite._read_pyc(path, written) is None and rewrite.try_makedirs(written.parent):
                source, code = rewrite._rewrite_test(path, config)
                rewrite._write_pyc(config.stash[rewrite.assertstate_key], code, source, written)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distributes files as ``--dist loadfile`` does, those that belong together as one."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class FilesTogether(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            path = file.removeprefix("tests/")
            return next((name for name, files in TOGETHER.items() if path.startswith(files)), file)

    return FilesTogether(config, log)


@pytest.fixture(scope="session", autouse=True)
def quick_files() -> Iterator[None]:
    """No test's files need survive a power cut, and no PNG need be small: a texture takes a third of the time."""
    from PIL import Image

    save = Image.Image.save

    def packed_quickly(image: Image.Image, *given: Any, **more: Any) -> None:
        save(image, *given, **{"compress_level": 1, **more})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        patch.setattr(Image.Image, "save", packed_quickly)
        yield


@pytest.fixture(scope="session", autouse=True)
def head_read_once() -> Iterator[None]:
    """A process reads the real head's files once, which takes seconds; each test has a copy of its own."""
    from torchface.io.rigs import ict_facekit

    known: dict[Any, Any] = {}

    def once(read: Any) -> Any:
        def copied(folder: Path, given: Any, *more: Any) -> Any:
            if Path(folder) != DATA / "ict_facekit" / "FaceXModel":
                return read(folder, given, *more)
            key = (read, more[-1], None if read is neutral else tuple(given))
            if key not in known:
                known[key] = read(folder, given, *more)
            return deepcopy(known[key])

        return copied

    neutral, deltas = ict_facekit._read_neutral, ict_facekit._read_deltas
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ict_facekit, "_read_neutral", once(neutral))
        patch.setattr(ict_facekit, "_read_deltas", once(deltas))
        yield


def pytest_collection_finish() -> None:
    """Leaves what was imported to no collection of garbage, and lets the ONNX exporter work less.

    It lists PyTorch's operators for each graph, a third of an export's time; and its search for simpler operators
    tries each pattern at each node, though most are no end of the pattern: that is a fifth.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)  # Python's 700 takes one part in twenty of a run
    gc.enable()
    if "torchface.onnx.exported_model" not in sys.modules:  # no test exports
        return
    from onnxscript.rewriter import _basics, _matcher
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    listed = cache(ONNXRegistry.from_torchlib)

    def remembered(opset_version: int) -> ONNXRegistry:
        registry = copy(listed(opset_version))
        registry.functions = {target: list(known) for target, known in registry.functions.items()}
        return registry

    ONNXRegistry.from_torchlib = staticmethod(remembered)
    matched = _matcher.SimplePatternMatcher.match

    def matched_at_its_end(matcher: Any, model: Any, graph: Any, node: Any, **more: Any) -> Any:
        ends = matcher.pattern.output_nodes[0].op_identifier()
        if ends is not None and ends[:2] != (node.domain, node.op_type):
            return _basics.MatchResult().fail("another operator")
        return matched(matcher, model, graph, node, **more)

    _matcher.SimplePatternMatcher.match = matched_at_its_end


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the longest tests first; those on real data are skipped where there is none."""

    def rank(item: pytest.Item) -> int:
        path = item.path.relative_to(REPOSITORY).as_posix()
        return next((i for i, folder in enumerate(LONGEST) if path.startswith(f"tests/{folder}")), len(LONGEST))

    items.sort(key=rank)
    if DATA.is_dir():
        return
    skip = pytest.mark.skip(reason=f"real data not found at {DATA}; set TORCHFACE_DATA to run this test")
    for item in items:
        if item.get_closest_marker("real"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real data; mark the test ``real`` to have it skipped where there is none."""
    return DATA


@pytest.fixture(scope="session")
def ict_folder(data: Path) -> Path:
    """ICT-FaceKit's FaceXModel folder as its users download it."""
    return data / "ict_facekit" / "FaceXModel"


@pytest.fixture(scope="session")
def performances(data: Path) -> list[Path]:
    """Real Live Link Face takes."""
    return sorted((data / "performances").glob("*.csv"))


@pytest.fixture(scope="session")
def real_capture(ict_folder: Path, performances: list[Path]) -> tuple[BlendshapeRig, Attachment, list[torch.Tensor]]:
    """A real rig's face (53 shapes), 100 markers on it, and the real takes as its weights, (T,53) each.

    The markers come best first, so the first 50 are a layout of their own.
    """
    from torchface.io import load_rig, load_take
    from torchface.shape_names import mapping
    from torchface.synthetic.stages.marker_stage import place_markers

    rig = load_rig(ict_folder, part="face")
    weights = []
    for path in performances:
        track = load_take(path).weights
        weights.append((track.values[..., 0] @ mapping(track.names, rig.names).T).clamp(0, 1))
    return rig, place_markers(rig, 100), weights


@pytest.fixture(scope="module")
def coarse_figures() -> Iterator[None]:
    """Figures of reports with one ray for 4 × 4 pixels and no shadow in creases, for tests that do not look at them."""
    import torch

    from torchface.rendering.clay_shading import DEFAULT_LIGHTING, render

    figures = ("face_views", "marker_maps", "registration_views")
    pages = (
        "workflows.fit.photograph_rig",
        "workflows.rig.predicted_rig",
        "workflows.solve.solve_page",
        "workflows.register.scan_job",
        "workflows.batch.contact_sheet",
        "workflows.enhance.enhance_views",
    )

    def coarse(mesh: Mesh, camera: Camera, *rest: Any, **more: Any) -> torch.Tensor:
        given = inspect.signature(render).bind(mesh, camera, *rest, **more)
        lighting = replace(given.arguments.pop("lighting", DEFAULT_LIGHTING), occlusion_rays=0)
        middle = torch.tensor([[0.0, 0, 0.375], [0, 0, 0.375], [0, 0, 0]], dtype=torch.float64)  # of 4 pixels
        scaled = camera.intrinsics.double() * torch.tensor([[0.25], [0.25], [1.0]], dtype=torch.float64) - middle
        few = replace(camera, intrinsics=scaled, width=-(-camera.width // 4), height=-(-camera.height // 4))
        drawn = render(**{**given.arguments, "camera": few, "lighting": lighting, "samples": 1})
        return drawn.repeat_interleave(4, 1).repeat_interleave(4, 2)[:, : camera.height, : camera.width]

    with pytest.MonkeyPatch.context() as patch:
        for module in (*(f"viz.figures.{name}" for name in figures), *pages):
            patch.setattr(f"torchface.{module}.render", coarse)
        patch.setattr("torchface.viz.figures.registration_views._SAMPLES", 1)
        yield


@pytest.fixture(scope="session")
def dome_rig() -> BlendshapeRig:
    """A dome that bulges here and there: 100 mm wide, four shapes; the lowest rows never move."""
    import torch

    from torchface.mesh import Mesh
    from torchface.rig import BlendshapeRig

    side = 25
    y, x = torch.meshgrid(torch.linspace(-50, 50, side), torch.linspace(-50, 50, side), indexing="ij")
    vertices = torch.stack([x, y, 60 - (x**2 + y**2) / 100], dim=-1).reshape(-1, 3)
    corner = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).reshape(-1)
    quads = torch.stack([corner, corner + 1, corner + side + 1, corner + side], dim=1)
    centres = torch.tensor([[-25.0, 25], [25, 25], [0, 0], [0, 35]])
    bulge = torch.exp(-((vertices[None, :, :2] - centres[:, None]) ** 2).sum(-1) / 400) * (vertices[:, 1] > -35)
    direction = torch.tensor([[0.0, 2, 6], [0, 3, 5], [4, 0, 3], [0, -5, 2]])
    return BlendshapeRig(
        Mesh.from_polygons(vertices, quads),
        bulge[..., None] * direction[:, None],
        ["jawOpen", "browInnerUp", "mouthSmileLeft", "mouthSmileRight"],
    )


@pytest.fixture(scope="session")
def filmed_session(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A performer before the camera stage: two repetitions of each unit, one of a combination, 20 frames a second."""
    import torch

    from train.filmed_performers import camera_stage
    from train.filmed_performers.action_performance import PerformanceSettings
    from train.filmed_performers.camera_stage import StageSettings
    from train.filmed_performers.helmet_camera import CameraFlaws
    from train.filmed_performers.reflective_paint import reflective_paint

    performance = PerformanceSettings(2, 1, (("4", "9"),), fps=20.0, pace=1.3)
    flaws = CameraFlaws(shake_rotation=0.6, shake_translation=1.2)
    settings = StageSettings(128, 170, markers=20, flaws=flaws, performance=performance)
    folder = tmp_path_factory.mktemp("camera_stage")
    with pytest.MonkeyPatch.context() as patch:  # of a texture as fine as the pictures
        patch.setattr(camera_stage, "reflective_paint", lambda size, *more: reflective_paint(size // 2, *more))
        return camera_stage.record_session(folder, "first", None, torch.Generator().manual_seed(3), settings)


@pytest.fixture
def receiver() -> Iterator[Any]:
    """An ``OscReceiver`` on a port of its own."""
    from osc_receiver import OscReceiver

    opened = OscReceiver()
    yield opened
    opened.server.server_close()


@pytest.fixture(scope="session")
def started_chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from headless_chromium import headless_chromium

    with headless_chromium(tmp_path_factory.mktemp("chromium"), size=(600, 600)) as driver:
        yield driver


@pytest.fixture(scope="module")
def chromium(started_chromium: Any) -> Iterator[Any]:
    """The driver of a Chromium that draws pages, one after the other; the last one is left: it would be drawn on."""
    yield started_chromium
    started_chromium.get("about:blank")
    started_chromium.set_window_size(600, 600)


@pytest.fixture
def messages_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command, which ends with ``status``; gives what it says on its error stream, its words a space apart."""
    from torchface.cli import main

    def run(*words: object, status: int = 0) -> str:
        ended: object = 0
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            ended = end.code or 0
        printed = " ".join(capsys.readouterr().err.split())
        assert ended == status, printed
        return printed

    return run
