"""The page's modules under Node, and the app in a Chromium that the tests of a process share."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from app_browser import WINDOW, Open, Page, elsewhere, film_camera, static_host
from film import planted_film, write_y4m
from headless_chromium import headless_chromium, until
from planted_graph import write_planted_graph
from recorded_take import Recorded, allow_camera, record, watch
from rig_samples import named_sheet

from torchface.errors import MissingExtraError
from torchface.io import save_rig
from torchface.progress import silent
from torchface.workflows.browser_app import export_app
from torchface.workflows.browser_app.built_page import installed_packages, page_sources

FRAMES, RATE = 48, 15


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str, object], Any]]:
    """Runs a job of ``modules.mjs``, all in one process; skips where node or the page's packages are missing."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed")
    folder = tmp_path_factory.mktemp("modules")
    try:
        (folder / "node_modules").symlink_to(installed_packages(page_sources(), npm, silent) / "node_modules")
    except MissingExtraError as error:
        pytest.skip(f"the page's packages cannot be installed here: {error}")
    shutil.copytree(page_sources() / "src", folder / "src")
    shutil.copy(page_sources() / "package.json", folder)
    shutil.copy(Path(__file__).parent / "modules.mjs", folder)

    def run(job: str, data: object) -> Any:
        path = data if isinstance(data, Path) else folder / "input.json"
        if path is not data:
            path.write_text(json.dumps(data))
        print(json.dumps([job, str(path)]), file=process.stdin, flush=True)
        answer = json.loads(process.stdout.readline() or '{"error": "it ended"}')
        assert "error" not in answer, answer["error"]
        return answer["found"]

    with subprocess.Popen(
        [node, "modules.mjs", str(folder)], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield run


@pytest.fixture(scope="package")
def character(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of eight of ARKit's shapes, in another order and spelling, and one that ARKit does not know."""
    path = tmp_path_factory.mktemp("character") / "sheet.glb"
    names = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", "EyeBlinkLeft", "antenna")
    save_rig(named_sheet(names), path)
    return path


@pytest.fixture(scope="package")
def app(character: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The app's folder, with a graph that reads planted weights off the picture."""
    folder = tmp_path_factory.mktemp("app")
    write_planted_graph(folder / "planted.onnx")
    try:
        export_app(folder / "app", character, folder / "planted.onnx")
    except MissingExtraError as error:
        pytest.skip(f"the page cannot be built here: {error}")
    return folder / "app"


@pytest.fixture(scope="package")
def opened(app: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Open]:
    """The app in Chromium; the film has no face in its second half."""
    folder = tmp_path_factory.mktemp("camera")
    write_y4m(folder / "film.y4m", planted_film(FRAMES, range(FRAMES // 2, FRAMES)), RATE)
    switches = film_camera(folder / "film.y4m")
    with (
        static_host(app) as host,
        elsewhere() as outside,
        # Drawing in software takes seconds to begin with, and test_app_film.py looks at that.
        headless_chromium(
            folder / "profile", *switches, "--disable-3d-apis", f"--proxy-server={outside.url}", size=WINDOW
        ) as driver,
    ):
        watch(driver)
        allow_camera(driver, "granted")
        driver.get(f"{host.url}/index.html")
        page = Page(driver)
        until(lambda: page.text("character-line"))
        assert "cannot be drawn" in page.text("undrawn")  # and all else works
        yield Open(page, host, outside)


@pytest.fixture(scope="package")
def recorded(opened: Open, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(opened.page, tmp_path_factory.mktemp("recorded"), 10)
