"""The player in a report: opened from disk, it moves the face as the rig does and colours what is wrong."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from torchface import Annotations, BlendshapeRig, Mesh
from torchface.errors import ShapeError
from torchface.rendering.part_colors import clear_triangles, region_colors
from torchface.viz.reports.player import Markers, Panel, Played, Player, write_player
from torchface.viz.reports.report_page import Section, write_page


def written(rig: BlendshapeRig, folder: Path) -> Path:
    """A page in which the true face puffs its right half and the solved one does not, from the second frame on."""
    true, solved = torch.zeros(4, len(rig.names)), torch.zeros(4, len(rig.names))
    true[1:, rig.names.index("mouthSmileLeft")] = 1.0
    takes = [Played("true", rig, true), Played("solved", rig, solved)]
    panels = [Panel("true", 0, markers=True), Panel("distance", error=True)]
    markers = Markers(torch.tensor([[[0.0, 0, 126]]]).repeat(4, 1, 1))
    player = Player(takes, panels, 30.0, (1, 0), 0, ("mouthSmileLeft",), markers, 10.0)
    folder.mkdir()
    markup = write_player(player, folder)
    return write_page(folder, "A page", [Section("Performance", markup=markup)])


def test_it_plays_from_disk_and_colours_the_distance(chromium: Any, ball_rig: BlendshapeRig, tmp_path: Path) -> None:
    chromium.get("about:blank")
    chromium.get_log("browser")  # what pages of other tests had to say until they were left
    chromium.get(written(ball_rig, tmp_path / "report").as_uri())

    def picture(frame: int) -> torch.Tensor:
        script = "const p = document.getElementById('performance').player; p.toggle(false); p.seek(arguments[0]);"
        shown = "requestAnimationFrame(() => requestAnimationFrame(arguments[1]))"
        chromium.execute_async_script(script + shown, frame)
        canvas = chromium.find_element("css selector", "#performance .stage canvas")
        with Image.open(BytesIO(canvas.screenshot_as_png)) as image:
            return torch.from_numpy(np.asarray(image.convert("RGB")).copy()).float()

    rest, moved = picture(0), picture(2)
    half = rest.shape[1] // 2
    # The true face, on the left, changes on the side that the smile moves (the viewer's right) and not on the other.
    change = (moved - rest).abs().sum(-1)[:, :half]
    assert float(change[:, half // 2 + 10 :].mean()) > 1
    assert float(change[:, : half // 2 - 30].mean()) < 0.3 * float(change[:, half // 2 + 10 :].mean())
    # At rest the distance is nought everywhere, the darkest blue; then red and yellow where the solved face lacks it.
    assert int((rest[:, half:, 0] > rest[:, half:, 2] + 60).sum()) == 0
    assert int((moved[:, half:, 0] > moved[:, half:, 2] + 60).sum()) > 500
    errors = [entry for entry in chromium.get_log("browser") if entry["level"] == "SEVERE"]
    assert not errors


def test_shapes_that_differ_are_refused(ball_rig: BlendshapeRig, two_balls: Mesh, tmp_path: Path) -> None:
    other = BlendshapeRig(two_balls, ball_rig.deltas[:2], ball_rig.names[:2])
    takes = [Played("a", ball_rig, torch.zeros(3, 8)), Played("b", other, torch.zeros(3, 2))]
    with pytest.raises(ShapeError, match=r"found weights \(3, 2\)"):
        write_player(Player(takes, [Panel("a", 0)], 30.0), tmp_path)


def test_eyes_without_colour_show_where_they_look_and_clear_shells_do_not_hide_them() -> None:
    def ball(radius: float) -> tuple[torch.Tensor, torch.Tensor]:
        sphere = trimesh.creation.icosphere(4, radius)
        return torch.tensor(sphere.vertices).float() + torch.tensor([30.0, 0, 0]), torch.tensor(sphere.faces).long()

    vertices, faces = ball(12.0)
    shell, shell_faces = ball(13.0)
    eye = torch.arange(len(vertices) + len(shell)) < len(vertices)
    regions = {"eyeball_left": eye, "eye_occlusion_left": ~eye}
    mesh = Mesh(
        torch.cat([vertices, shell]),
        torch.cat([faces, shell_faces + len(vertices)]),
        annotations=Annotations(regions=regions),
    )
    assert torch.equal(clear_triangles(mesh), torch.arange(len(mesh.faces)) >= len(faces))
    colors = region_colors(mesh)[eye]
    dark = colors.amax(1) < 0.2
    assert 0 < int(dark.sum()) < 0.05 * len(vertices)
    assert bool((vertices[dark, 2] > 11).all())
    assert bool((colors[vertices[:, 2] < 0].amin(1) > 0.85).all())
