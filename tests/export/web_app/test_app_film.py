"""The app with the webcam's own graph before films of rendered faces: Python's weights, drawn, and how fast."""

import io
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from app_browser import Page, film_camera, static_host
from film import write_y4m
from headless_chromium import headless_chromium, until
from PIL import Image
from recorded_take import allow_camera, assert_same_weights, blob, record, watch

from torchface.errors import MissingExtraError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.video import open_video
from torchface.workflows.browser_app import export_app
from torchface.workflows.webcam.webcam_graph import webcam_graph
from train.rendered_people.webcam_video import talking_subject

pytestmark = [pytest.mark.browser, pytest.mark.bench]
TOLERANCE = 0.02


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("app") / "app"
    try:
        report = export_app(folder)
    except MissingExtraError as error:
        pytest.skip(f"the page cannot be built here: {error}")
    assert sum(report.packed.values()) < 12_000_000
    return folder


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    return np.stack(talking_subject(24))


@contextmanager
def opened(
    app: Path, frames: np.ndarray, folder: Path, isolated: bool = False, streamed: bool = False
) -> Iterator[Page]:
    write_y4m(folder / "film.y4m", frames)
    with (
        static_host(app, isolated) as host,
        headless_chromium(folder / "profile", *film_camera(folder / "film.y4m"), size=(800, 700)) as driver,
    ):
        watch(driver, streamed)
        allow_camera(driver, "granted")
        driver.get(f"{host.url}/index.html")
        yield Page(driver)


@pytest.mark.parametrize("isolated", [False, True])
def test_weights_are_pythons_the_character_is_drawn_and_the_rate_is_told(
    app: Path, faces: np.ndarray, tmp_path: Path, isolated: bool
) -> None:
    with opened(app, faces, tmp_path, isolated) as page:
        recorded = record(page, tmp_path, 40)
        assert_same_weights(webcam_graph(), recorded, TOLERANCE)
        assert np.array([one["weights"] for one in recorded.solved]).std(0).max() > 0.02
        until(lambda: not page.driver.find_element("id", "loading").is_displayed())  # a busy machine may draw later
        assert drawn_contrast(page) > 15
    with opened(app, faces, tmp_path, isolated, streamed=True) as page:
        page.start()
        until(lambda: page.driver.execute_script("return watched.solved.length") >= 150)
        told = page.driver.execute_script("return watched.solved.slice(-100).map(s => [s.interval, s.milliseconds])")
        times, solving = np.array(told).T  # without what is slow at first, and without pictures that are kept
        print(
            f"\n{'isolated' if isolated else 'one thread'}: {1 / times.mean():.0f} frames a second, "
            f"{np.median(solving):.0f} ms a frame in the worker, least {solving.min():.0f}"
        )


def drawn_contrast(page: Page) -> float:
    """The standard deviation of the grey levels where the character is drawn."""
    picture = Image.open(io.BytesIO(page.driver.find_element("id", "character").screenshot_as_png))
    return float(np.asarray(picture.convert("L"), float).std())


def test_of_two_faces_one_is_followed(app: Path, faces: np.ndarray, tmp_path: Path) -> None:
    width = faces.shape[2]
    with opened(app, np.concatenate([faces, faces[:, :, ::-1]], axis=2), tmp_path) as page:
        page.start()
        until(lambda: page.driver.execute_script("return watched.solved.length") >= 20)
        nose = "return watched.solved.slice(3).map(s => s.landmarks[60])"
        sides = np.array(page.driver.execute_script(nose), float)
        assert np.isfinite(sides).all()
        assert (sides < width).all() or (sides >= width).all()


def test_a_take_is_saved_as_film_and_as_usd_with_its_textures(app: Path, faces: np.ndarray, tmp_path: Path) -> None:
    """Read by FFmpeg and by OpenUSD; the camera's film too."""
    from pxr import Usd, UsdShade

    with opened(app, faces, tmp_path) as page:
        page.driver.execute_script("document.getElementById('keep-film').click()")
        recorded = record(page, tmp_path, 20)
        for kind, name in ((".mp4", "take.mp4"), (".usdz", "take.usdz"), ("film", "camera.mp4")):
            (tmp_path / name).write_bytes(blob(page, kind))
    animated = read_gltf_weights(recorded.glb)
    seconds = animated.times
    with av.open(str(tmp_path / "take.mp4")) as film:
        stream = film.streams.video[0]
        frames = list(film.decode(stream))
    assert (stream.codec_context.name, stream.width, stream.height) == ("h264", 1280, 720)
    assert len(frames) == len(seconds)
    times = [float(frame.pts * stream.time_base) for frame in frames]
    np.testing.assert_allclose(np.diff(times), np.diff(seconds), atol=2e-3)
    assert float(stream.average_rate or 0) == pytest.approx((len(seconds) - 1) / float(seconds[-1]), rel=1e-3)
    assert frames[-1].to_ndarray(format="gray").std() > 15
    filmed = replace(open_video(tmp_path / "camera.mp4"), even=False)  # a busy machine leaves frames out
    assert len(list(filmed.color_frames())) > 2
    stage = Usd.Stage.Open(str(tmp_path / "take.usdz"))
    files = [
        UsdShade.Shader(prim).GetInput("file").Get()
        for prim in stage.Traverse()
        if prim.IsA(UsdShade.Shader) and UsdShade.Shader(prim).GetInput("file")
    ]
    assert files
    assert all(file.resolvedPath for file in files)
    with zipfile.ZipFile(tmp_path / "take.usdz") as package:
        assert package.testzip() is None
        infos = package.infolist()
        starts = [one.header_offset + 30 + len(one.filename) + extra_bytes(package, one) for one in infos]
        assert not any(start % 64 for start in starts)
        sides = [Image.open(io.BytesIO(package.read(info))).size for info in infos if info.filename.endswith(".png")]
    assert min(min(side) for side in sides) >= 256


def extra_bytes(package: zipfile.ZipFile, info: zipfile.ZipInfo) -> int:
    """The size of the extra field before a file's data, which aligns it."""
    package.fp.seek(info.header_offset + 28)
    return int(struct.unpack("<H", package.fp.read(2))[0])
