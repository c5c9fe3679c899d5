"""The app's controls, characters and takes in a real Chromium, as hands, keys and screen readers have them."""

from pathlib import Path

import pytest
import torch
from app_browser import Open
from headless_chromium import until
from recorded_take import Recorded, blob, watched
from rig_samples import named_sheet, quad_sheet
from test_gltf_viewers import WEB, node  # noqa: F401  (its packages)

from torchface import BlendshapeRig, load_take, save_mesh, save_rig
from torchface.workflows.browser_app.character import load_character

pytestmark = pytest.mark.browser


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
        driver.execute_script("document.getElementById('controls').scrollIntoView()")  # as on a phone
        page.click("calibrate")
        words = "return document.getElementById('prompt-words').getBoundingClientRect().top"
        assert 0 <= driver.execute_script(words) < driver.execute_script("return innerHeight")
        assert page.text("prompt-words") == "1 of 6: Look into the camera with a resting face."
        assert page.text("spoken") == "Look into the camera with a resting face."
        assert driver.switch_to.active_element.get_attribute("id") == "prompt-stop"
    # Rest, or what is asked for after it where a busy machine sees too few pictures for a face that rests.
    until(lambda: any(one["pose"] for one in watched(page, f"watched.sent.slice({count})")))
    driver.switch_to.active_element.send_keys(Keys.ESCAPE)
    assert not driver.find_element("id", "prompt").is_displayed()
    assert driver.switch_to.active_element.get_attribute("id") == "calibrate"


def test_a_dropped_character_is_taken(opened: Open, tmp_path: Path) -> None:
    """Dragged by the browser's own events, over the camera's picture and let go there."""
    page, driver = opened.page, opened.page.driver
    save_rig(named_sheet(("jawOpen",)), tmp_path / "dropped.glb")
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
    driver.execute_script("document.querySelector('#takes .trim').click()")  # it stays open by itself
    driver.execute_script(opening, False)
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def broken(folder: Path) -> dict[str, tuple[Path, str]]:
    """Files that no face can move, and what the page says."""
    good = folder / "good.glb"
    save_rig(named_sheet(("jawOpen", "mouthClose")), good)
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


def test_shapes_that_move_nothing_are_said(opened: Open, tmp_path: Path) -> None:
    rig = named_sheet(("jawOpen", "mouthClose", "jawLeft"))
    deltas = rig.deltas * torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    save_rig(BlendshapeRig(rig.neutral, deltas, rig.names), tmp_path / "still.glb")
    opened.page.driver.find_element("id", "file").send_keys(str(tmp_path / "still.glb"))
    said = "still.glb: your face moves 1 of its 3 shapes; its mouthClose, jawLeft move nothing"
    until(lambda: opened.page.text("character-line") == said)


def test_names_of_shapes_are_changed_and_kept_for_the_character(opened: Open, tmp_path: Path) -> None:
    page, driver = opened.page, opened.page.driver
    save_rig(named_sheet(("alpha", "beta")), tmp_path / "strange.glb")
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
    driver.execute_script(press, ".trimming button")
    until(lambda: len(driver.execute_script(names)) == count + 1)
    facts = driver.execute_script("return [...document.querySelectorAll('#takes li > span')].map(e => e.innerText)")
    assert facts[0] == facts[1]  # all of it: the last frame too, though its time is no hundredth
    driver.execute_script(press, "#takes .delete")
    until(lambda: len(driver.execute_script(names)) == count)
    driver.execute_script(press, "#takes .trim")
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


def test_an_empty_take_is_said_and_a_running_one_is_not_left_unasked(opened: Open, recorded: Recorded) -> None:
    page, driver = opened.page, opened.page.driver
    leave = "const e = new Event('beforeunload', { cancelable: true }); dispatchEvent(e); "
    page.start()
    press = "document.getElementById('record').click(); "
    # Begun and ended before a picture can come.
    assert driver.execute_script(f"{press}{leave}{press}return e.defaultPrevented")
    assert "Nothing was recorded" in until(lambda: page.problem, 20)
    assert not driver.execute_script(f"{leave}return e.defaultPrevented")
    driver.execute_script("document.querySelector('#problem button').click()")
    page.stop()


def test_what_is_loaded_is_said_in_bytes(opened: Open, app: Path) -> None:
    opened.page.start()
    told = watched(opened.page, "watched.loaded")
    assert max(one["bytes"] for one in told) == (app / "webcam.graph").stat().st_size
    assert told[-1]["loaded"] == 3  # and then it is ready
    opened.page.stop()


def test_the_character_is_asked_for_before_the_face_reader(opened: Open) -> None:
    """And nothing is said to be on its way once all is here."""
    asked = [path for _, path in opened.host.requests]
    assert asked.index("/character.glb") < asked.index("/webcam.graph")
    assert not opened.page.driver.find_element("id", "loading").is_displayed()
    until(lambda: opened.page.text("status") == "Start the camera to begin.")


@pytest.mark.real
def test_a_character_of_meshopt_and_ktx2_is_taken(opened: Open, data: Path) -> None:
    """Face Cap's head as three.js ships it, by the decoders that the page brings."""
    page = opened.page
    page.driver.find_element("id", "file").send_keys(str(data / "characters" / "facecap.glb"))
    until(
        lambda: (
            page.text("character-line")
            == "facecap.glb: your face moves 51 of its 52 shapes; its tongueOut moves nothing"
            or page.problem
        )
    )
    assert page.problem == ""
