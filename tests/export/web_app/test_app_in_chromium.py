"""The app in a real Chromium whose camera is a film: what it records, what it says, and that nothing leaves it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from app_browser import Page, Server, elsewhere, film_camera, static_host
from film import planted_film, write_y4m
from headless_chromium import headless_chromium, until
from planted_graph import write_planted_graph
from recorded_take import Recorded, allow_camera, assert_same_weights, blob, record, watch, watched
from rig_samples import quad_sheet
from test_gltf_viewers import WEB, assert_valid, node  # noqa: F401  (its packages)

from torchface import BlendshapeRig
from torchface.errors import MissingExtraError
from torchface.io import load_rig, load_take, save_mesh, save_rig
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.weights.live_link_csv import load_live_link
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app import export_app
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.track.head_rotations import head_angles

pytestmark = pytest.mark.browser
FRAMES, RATE = 48, 15
WINDOW = (480, 360)
BROWSERS_OWN = ("google.com", "googleapis.com", "gstatic.com", "duckduckgo.com")
"""Where Chromium calls by itself, whatever page is open."""


def sheet(names: tuple[str, ...]) -> BlendshapeRig:
    mesh = quad_sheet()
    generator = torch.Generator().manual_seed(0)
    return BlendshapeRig(mesh, torch.randn(len(names), len(mesh.vertices), 3, generator=generator), names)


@pytest.fixture(scope="module")
def character(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of eight of ARKit's shapes, in another order and spelling, and one that ARKit does not know."""
    path = tmp_path_factory.mktemp("character") / "sheet.glb"
    names = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", "EyeBlinkLeft", "antenna")
    save_rig(sheet(names), path)
    return path


@pytest.fixture(scope="module")
def app(character: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The app's folder, with a graph that reads planted weights off the picture."""
    folder = tmp_path_factory.mktemp("app")
    write_planted_graph(folder / "planted.onnx")
    try:
        export_app(folder / "app", character, folder / "planted.onnx")
    except MissingExtraError as error:
        pytest.skip(f"the page cannot be built here: {error}")
    return folder / "app"


@dataclass
class Open:
    page: Page
    host: Server
    outside: Server


@pytest.fixture(scope="module")
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


@pytest.fixture(scope="module")
def recorded(opened: Open, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(opened.page, tmp_path_factory.mktemp("recorded"), 10)


def test_recorded_weights_are_those_of_onnx_runtime_in_python(app: Path, recorded: Recorded) -> None:
    """On the very pixels and intervals that the page gave its worker."""
    assert_same_weights(app / "webcam.onnx", recorded, 1e-5)
    rows = load_take(recorded.csv).weights
    assert rows is not None
    answers = np.array([one["weights"] for one in recorded.recorded])
    np.testing.assert_allclose(rows.values[..., 0], answers, rtol=0, atol=1e-7)
    assert len(answers) > 5
    assert answers.std(0).min() > 0.01  # the film moves every shape


def test_the_csv_has_the_cameras_times_and_the_heads_rotation(recorded: Recorded) -> None:
    take = load_live_link(recorded.csv)
    assert take.timecode is not None
    steps = np.array([one["interval"] for one in recorded.recorded[1:]])
    base = min((15, 20, 24, 25, 30, 50, 60), key=lambda rate: abs(rate * np.median(steps) - 1))
    clocks = [[float(part) for part in text.split(":")] for text in take.timecode]
    seconds = np.array([3600 * h + 60 * m + s + frame / base for h, m, s, frame in clocks])
    np.testing.assert_allclose(np.diff(seconds), steps, rtol=0, atol=1e-3)
    rotations = torch.tensor([one["rotation"] for one in recorded.recorded], dtype=torch.float64).reshape(-1, 3, 3)
    columns = take.extras["columns"]
    found = torch.stack([columns[f"Head{axis}"] for axis in ("Yaw", "Pitch", "Roll")], dim=1)
    torch.testing.assert_close(found, head_angles(rotations), rtol=0, atol=1e-6)
    assert found[:, 0].std() > 0.05
    # Planted: both eyes 0.1 to the person's left and 0.05 up, which the app's recordings have as negative.
    assert (columns["LeftEyeYaw"] + 0.1).abs().max() < 1e-6
    assert (columns["RightEyePitch"] + 0.05).abs().max() < 1e-6


def test_the_glb_has_the_recording_as_its_animation(character: Path, recorded: Recorded) -> None:
    take, told = read_gltf_weights(recorded.glb), load_live_link(recorded.csv)
    rig, before = load_rig(recorded.glb), load_rig(character)
    torch.testing.assert_close(rig.deltas, before.deltas)
    assert take is not None
    assert take.weights is not None
    assert told.weights is not None
    assert take.weights.names == rig.names == before.names
    column = {name: i for i, name in enumerate(ARKIT)}
    source = {"mouthSmile_L": "mouthSmileLeft", "mouthSmile_R": "mouthSmileRight", "EyeBlinkLeft": "eyeBlinkLeft"}
    for i, name in enumerate(rig.names):
        values = take.weights.values[:, i, 0]
        if name == "antenna":
            assert not values.any()
            continue
        arkit = source.get(name, name.removesuffix("_L").removesuffix("_R"))
        torch.testing.assert_close(values, told.weights.values[:, column[arkit], 0], rtol=0, atol=1e-6)


def test_khronos_validator_finds_nothing_in_the_glb(recorded: Recorded, node: str) -> None:  # noqa: F811
    assert_valid(node, recorded.glb)


def test_only_files_of_the_page_were_asked_for(opened: Open, recorded: Recorded) -> None:
    assert {method for method, _ in opened.host.requests} == {"GET"}
    paths = {path for _, path in opened.host.requests}
    known = ("/index.html", "/webcam.onnx", "/character.glb", "/character.json")
    assert set(known) <= paths
    assert all(path.startswith((*known, "/assets/")) for path in paths)
    strangers = [path for _, path in opened.outside.requests if not any(own in path for own in BROWSERS_OWN)]
    assert strangers == []


FETCH = "fetch('http://elsewhere.test/{}', {{mode: 'no-cors'}}).then(() => 'answered', () => 'refused')"


def test_the_policy_lets_nothing_out_neither_from_the_page_nor_from_its_worker(
    opened: Open, recorded: Recorded
) -> None:
    driver = opened.page.driver

    def asked(code: str) -> str:
        return driver.execute_async_script(f"const done = arguments[0]; ({code}).then(done)")

    in_worker = """new Promise(done => {
        const code = `${FETCH}.then(answer => postMessage(answer))`;
        const worker = new Worker(URL.createObjectURL(new Blob([code], {type: "text/javascript"})), {type: "module"});
        worker.onmessage = ({data}) => done(data); worker.onerror = () => done("refused");
    })"""
    assert asked(FETCH.format("page")) == "refused"
    assert asked(in_worker.replace("${FETCH}", FETCH.format("worker"))) == "refused"
    posted = "fetch('http://elsewhere.test/post', {method: 'POST', mode: 'no-cors', body: 'x'})"
    assert asked(posted + ".then(() => 'answered', () => 'refused')") == "refused"
    driver.execute_script("navigator.sendBeacon('http://elsewhere.test/beacon', 'x')")
    driver.execute_script("new Image().src = 'http://elsewhere.test/picture'")
    driver.execute_async_script("setTimeout(arguments[0], 200)")
    assert not [path for _, path in opened.outside.requests if "elsewhere.test" in path]
    # The app's own worker is of that kind: one loaded from an address would not be under the page's policy.
    assert all(address.startswith("blob:") for address in watched(opened.page, "watched.workers"))


@pytest.fixture(scope="module")
def bare(app: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Open]:
    """A Chromium without a camera."""
    folder = tmp_path_factory.mktemp("bare")
    (app / "no_policy.html").write_text("<title>no policy</title>")
    with (
        static_host(app) as host,
        elsewhere() as outside,
        headless_chromium(
            folder / "profile", "--disable-3d-apis", f"--proxy-server={outside.url}", size=WINDOW
        ) as driver,
    ):
        yield Open(Page(driver), host, outside)


def test_without_the_policy_the_same_request_is_seen(bare: Open) -> None:
    """So the proxy would have seen those that the policy refused."""
    bare.page.driver.get(f"{bare.host.url}/no_policy.html")
    code = f"const done = arguments[0]; {FETCH.format('control')}.then(done)"
    assert bare.page.driver.execute_async_script(code) == "answered"
    assert ("GET", "http://elsewhere.test/control") in bare.outside.requests


def test_a_missing_camera_is_explained(bare: Open) -> None:
    bare.page.driver.get(f"{bare.host.url}/index.html")
    bare.page.click("start")
    assert until(lambda: bare.page.problem).startswith("No camera was found")
    assert bare.page.text("start") == "Start camera"


def test_a_refused_camera_is_explained_and_may_be_allowed_then(opened: Open, recorded: Recorded) -> None:
    page = opened.page
    allow_camera(page.driver, "denied")
    page.click("start")
    assert "may not use the camera" in until(lambda: page.problem)
    allow_camera(page.driver, "granted")
    page.start()
    assert page.problem == ""


def test_a_permission_that_is_withdrawn_is_explained_and_ends_the_take(opened: Open, recorded: Recorded) -> None:
    page, count = opened.page, "return document.querySelectorAll('#takes li').length"
    page.start()
    before = page.driver.execute_script(count)
    page.click("record")
    until(lambda: page.recorded_frames >= 3)
    allow_camera(page.driver, "denied")
    assert "may no longer be used" in until(lambda: page.problem)
    until(lambda: page.driver.execute_script(count) == before + 1)
    page.driver.execute_script("document.querySelector('#takes .delete').click()")
    until(lambda: page.driver.execute_script(count) == before)
    allow_camera(page.driver, "granted")
    page.start()


def test_a_face_is_lost_and_found(opened: Open, recorded: Recorded) -> None:
    page = opened.page
    page.start()
    said = "return watched.said"
    count = len(page.driver.execute_script(said))

    def lost_then_found() -> bool:
        words = page.driver.execute_script(said)[count:]
        lost = [i for i, one in enumerate(words) if one.startswith("Your face is hidden")]
        return bool(lost) and any(one.startswith("Learning your face") for one in words[lost[0] :])

    until(lost_then_found)


def test_a_hidden_tab_pauses_and_goes_on_when_it_is_shown(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    page.start()
    count = "return watched.solved.length"
    with minimized(driver):
        until(lambda: page.text("status").startswith("Paused"))
        before = driver.execute_script(count)
        driver.execute_async_script("setTimeout(arguments[0], 600)")
        assert driver.execute_script(count) <= before + 1  # the one that was under way
    until(lambda: driver.execute_script(count) > before + 3)
    until(lambda: not page.text("status").startswith("Paused"))


def test_an_answer_that_comes_when_the_tab_is_hidden_does_not_end_the_pause(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    page.start()
    with page.held_pictures():
        until(lambda: driver.execute_script("return watched.held.length"))
        before = driver.execute_script("return watched.solved.length")
        with minimized(driver):
            until(lambda: page.text("status").startswith("Paused"))
            page.let_pictures_go()
            until(lambda: driver.execute_script("return watched.solved.length") > before)
            assert page.text("status").startswith("Paused")


@contextmanager
def minimized(driver: Any) -> Iterator[None]:
    driver.minimize_window()
    try:
        yield
    finally:
        driver.set_window_size(*WINDOW)


def test_controls_reach_the_graph(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    page.start()
    count = driver.execute_script("return watched.sent.length")
    page.click("reset")
    slide = (
        "const e = document.getElementById(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('input'))"
    )
    driver.execute_script(slide, "gain", 1.5)
    driver.execute_script(slide, "smoothing", 0)
    until(lambda: driver.execute_script("const e = watched.sent.at(-1); return e.gain === 1.5 && e.smoothing === 0"))
    assert sum(one["reset"] for one in watched(page, f"watched.sent.slice({count})")) == 1
    assert page.text("gain-value") == "1.5"


@pytest.mark.bench
def test_calibration_is_spoken_and_left_with_escape(opened: Open, recorded: Recorded) -> None:
    from selenium.webdriver.common.keys import Keys

    page, driver = opened.page, opened.page.driver
    page.start()
    count = driver.execute_script("return watched.sent.length")
    with page.held_pictures():  # so the first step lasts while it is looked at
        page.click("calibrate")
        assert page.text("prompt-words") == "1 of 6: Look into the camera with a resting face."
        assert page.text("spoken") == "Look into the camera with a resting face."
        assert driver.switch_to.active_element.get_attribute("id") == "prompt-stop"
    until(lambda: 1 in [one["pose"] for one in watched(page, f"watched.sent.slice({count})")])
    driver.switch_to.active_element.send_keys(Keys.ESCAPE)
    assert not driver.find_element("id", "prompt").is_displayed()
    assert driver.switch_to.active_element.get_attribute("id") == "calibrate"


def test_a_dropped_character_is_taken(opened: Open, tmp_path: Path) -> None:
    """Dragged by the browser's own events, over the camera's picture and let go there."""
    page, driver = opened.page, opened.page.driver
    save_rig(sheet(("jawOpen",)), tmp_path / "dropped.glb")
    data = {"items": [], "files": [str(tmp_path / "dropped.glb")], "dragOperationsMask": 1}
    dragged = {"x": 150, "y": 200, "data": data}
    dropping = "return document.body.classList.contains('dropping')"

    def drag(kind: str) -> None:
        driver.execute_cdp_cmd("Input.dispatchDragEvent", {"type": kind, **dragged})

    def hinted() -> bool:
        drag("dragOver")
        return driver.execute_script(dropping)

    def dropped() -> bool:
        drag("dragOver")  # the browser lets go only where it knows by now that the page takes it
        drag("drop")
        return page.text("character-line") == "dropped.glb: your face moves 1 of its 1 shapes"

    drag("dragEnter")
    until(hinted)
    until(dropped)
    assert not driver.execute_script(dropping)
    assert driver.current_url.startswith(opened.host.url)  # not left for the file


def test_tab_goes_through_the_controls_in_the_order_in_which_they_stand(opened: Open, recorded: Recorded) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    page, driver = opened.page, opened.page.driver
    page.start()
    driver.execute_script("document.getElementById('start').focus()")
    focused = """
    const one = document.activeElement, { outlineStyle, outlineWidth } = getComputedStyle(one);
    const name = one.id || (one.tagName === "SELECT" ? one.className : one.textContent);
    return [name, outlineStyle, parseFloat(outlineWidth)];
    """
    found = []
    wanted = [
        "calibrate",
        "reset",
        "person",
        "gain",
        "smoothing",
        "mirror",
        "recenter",
        "freeze",
        "record",
        "keep-film",
        "choose",
        "own",
    ]
    wanted += ["Groups of shapes", "Names of shapes", "", "Play", "Trim", "save", "Delete", "Licences"]
    for _ in wanted:
        ActionChains(driver).send_keys(Keys.TAB).perform()
        found.append(driver.execute_script(focused))
    assert [name for name, *_ in found] == wanted  # a take's name has no text of its own
    assert all(style == "solid" and width >= 2 for _, style, width in found)  # and it is seen where one is


def test_who_wants_no_motion_gets_none(opened: Open) -> None:
    driver = opened.page.driver
    moving = """
    return [...document.querySelectorAll('*')].filter(one => {
        const style = getComputedStyle(one);
        return parseFloat(style.transitionDuration) > 0 || style.animationName !== 'none';
    }).length;
    """
    assert driver.execute_script(moving) > 0
    setting = {"name": "prefers-reduced-motion", "value": "reduce"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [setting]})
    assert driver.execute_script(moving) == 0
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_every_control_has_a_name_for_screen_readers(opened: Open) -> None:
    tree = opened.page.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    kinds = ("button", "slider", "switch", "image", "link", "progressbar")
    controls = [(one["role"]["value"], one["name"]["value"]) for one in tree if one["role"]["value"] in kinds]
    assert len(controls) >= 12
    assert all(name for _, name in controls), controls


AXE = """
const done = arguments[0], told = ({ id, impact, nodes }) => [id, impact, nodes[0].html];
axe.run(document).then(({ violations }) => done(violations.map(told)));
"""


@pytest.mark.parametrize("width", [390, pytest.param(480, marks=pytest.mark.bench)])
def test_axe_core_finds_nothing_and_nothing_is_wider_than_the_page(
    opened: Open,
    recorded: Recorded,
    node: str,  # noqa: F811
    width: int,
) -> None:
    page, driver = opened.page, opened.page.driver
    screen = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 480}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    driver.execute_script((WEB / "node_modules" / "axe-core" / "axe.min.js").read_text())
    page.start()
    opening = "for (const one of document.querySelectorAll('details')) one.open = arguments[0]"
    driver.execute_script(opening, True)
    driver.execute_script("document.querySelector('#takes .trim').click()")
    until(lambda: driver.execute_script("return document.querySelector('.trimming') !== null"))
    page.click("calibrate")
    assert driver.execute_async_script(AXE) == []
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    page.click("prompt-stop")
    driver.execute_script(opening, False)
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def broken(folder: Path) -> dict[str, tuple[Path, str]]:
    """Files that no face can move, and what the page says."""
    good = folder / "good.glb"
    save_rig(sheet(("jawOpen", "mouthClose")), good)
    data = good.read_bytes()
    save_mesh(quad_sheet(), folder / "still.glb")
    (folder / "text.glb").write_text("not a character")
    (folder / "cut.glb").write_bytes(data[: len(data) // 2])
    with (folder / "huge.glb").open("wb") as file:
        file.truncate(200 * 2**20)
    return {
        "still": (folder / "still.glb", "no morph targets"),
        "text": (folder / "text.glb", "no .glb file"),
        "cut": (folder / "cut.glb", "cut short"),
        "huge": (folder / "huge.glb", "200 MB"),
    }


def test_a_character_that_cannot_be_used_is_explained_and_the_one_before_stays(opened: Open, tmp_path: Path) -> None:
    page = opened.page
    before = page.text("character-line")
    chooser = page.driver.find_element("id", "file")
    for name, (path, words) in broken(tmp_path).items():
        chooser.send_keys(str(path))
        said = until(lambda path=path: page.problem if path.name in page.problem else "")
        assert words in said, name
        assert page.text("character-line") == before
    chooser.send_keys(str(tmp_path / "good.glb"))
    until(lambda: page.text("character-line") == "good.glb: your face moves 2 of its 2 shapes")
    assert page.problem == ""


def test_names_of_shapes_are_changed_and_kept_for_the_character(opened: Open, tmp_path: Path) -> None:
    page, driver = opened.page, opened.page.driver
    save_rig(sheet(("alpha", "beta")), tmp_path / "strange.glb")
    driver.find_element("id", "file").send_keys(str(tmp_path / "strange.glb"))
    until(lambda: "moves 0 of its 2 shapes; these stay still: alpha, beta. Say below" in page.text("character-line"))
    row = "const e = document.querySelector('[aria-label=\"alpha means\"]'); "
    driver.execute_script(row + "e.value = 'jawOpen'; e.dispatchEvent(new Event('change'))")
    known = "strange.glb: your face moves 1 of its 2 shapes; these stay still: beta"
    until(lambda: page.text("character-line") == known)
    driver.refresh()
    until(lambda: page.text("character-line") == known)
    assert driver.execute_script(row + "return e.value") == "jawOpen"
    count = driver.execute_script("return watched.blobs.length")
    driver.execute_script("document.getElementById('save-names').click()")
    until(lambda: driver.execute_script("return watched.blobs.length") > count)
    text = driver.execute_async_script("const done = arguments[0]; watched.blobs.at(-1).text().then(done)")
    (tmp_path / "names.toml").write_text(text)
    moved = load_character(tmp_path / "strange.glb", tmp_path / "names.toml")
    assert moved.shapes.undriven == ("beta",)


def test_takes_are_trimmed_taken_from_a_file_and_deleted(opened: Open, recorded: Recorded, tmp_path: Path) -> None:
    page, driver = opened.page, opened.page.driver
    names = "return [...document.querySelectorAll('#takes .name')].map(e => e.value)"
    count = len(driver.execute_script(names))
    press = "document.querySelector(arguments[0]).click()"
    driver.execute_script(press, "#takes .trim")
    slide = "const e = document.querySelectorAll('.trimming input'); e[0].value = 0.2; e[1].value = 0.55; "
    until(lambda: driver.execute_script("return document.querySelector('.trimming') !== null"))
    driver.execute_script(slide + "for (const one of e) one.dispatchEvent(new Event('input'))")
    driver.execute_script(press, ".trimming button")
    until(lambda: len(driver.execute_script(names)) == count + 1)
    assert driver.execute_script(names)[0].endswith(", part")
    (tmp_path / "part.csv").write_bytes(blob(page, ".csv"))
    part, whole = (load_take(path).weights.values for path in (tmp_path / "part.csv", recorded.csv))
    first = next(i for i in range(len(whole)) if torch.equal(whole[i], part[0]))
    assert first > 0
    assert len(part) < len(whole) - first
    torch.testing.assert_close(part, whole[first : first + len(part)], rtol=0, atol=0)
    drop = """
    const given = new DataTransfer(); given.items.add(new File([arguments[0]], arguments[1]));
    document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: given, bubbles: true }));
    """
    driver.execute_script(drop, (tmp_path / "part.csv").read_text(), "phone.csv")
    until(lambda: driver.execute_script(names)[0] == "phone")
    (tmp_path / "again.csv").write_bytes(blob(page, ".csv"))
    weights = [load_take(tmp_path / name).weights for name in ("part.csv", "again.csv")]
    torch.testing.assert_close(weights[0].values, weights[1].values, rtol=0, atol=1e-6)
    driver.execute_script(drop, "a,b\n1,2\n", "table.csv")
    assert "table.csv: this is no recording of ARKit's shapes" in until(lambda: page.problem)
    for left in (count + 1, count):
        driver.execute_script(press, "#takes .delete")
        until(lambda left=left: len(driver.execute_script(names)) == left)
    assert page.problem == ""  # what went wrong is no longer said after what went well


@pytest.mark.real
def test_a_character_of_meshopt_and_ktx2_is_taken(opened: Open, data: Path) -> None:
    """Face Cap's head as three.js ships it, by the decoders that the page brings."""
    page = opened.page
    page.driver.find_element("id", "file").send_keys(str(data / "characters" / "facecap.glb"))
    until(lambda: page.text("character-line") == "facecap.glb: your face moves 52 of its 52 shapes" or page.problem)
    assert page.problem == ""
