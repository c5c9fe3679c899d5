"""The report of a solve shows the face, finds the worst marker, and no gap hides a swap."""

import re
from pathlib import Path

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, clean_take
from torchface.evaluation import marker_rmse
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.synthetic.stages.marker_stage import StageFlaws, place_markers, record
from torchface.workflows.solve.solution import Solution, SolveReport
from torchface.workflows.solve.solve_page import write_solve_page


@pytest.fixture(scope="module")
def page(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a take with a swap, a spike and many gaps, solved with one site 4 mm wrong."""
    true = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(120)[:, None] / 9 + torch.arange(4))
    flaws = StageFlaws(noise=0.05, gaps=120, gap_seconds=0.1)
    recording = record(dome_rig, true, weights, torch.Generator().manual_seed(0), flaws)
    values = recording.take.markers.values.clone()
    values[50:70, [3, 20]] = values[50:70, [20, 3]]
    values[90, 5] += 15
    recorded = {"frame_numbers": torch.arange(480, 600)}
    take = Take(60.0, markers=Track(recording.take.markers.names, values), extras=recorded)
    points = true.on(dome_rig.neutral.faces, dome_rig.vertices)
    points[7, 0] += 4
    found = SurfaceIndex(dome_rig.vertices, dome_rig.neutral.faces).nearest(points)
    sites = Attachment(found.triangle, found.barycentric.float(), true.labels)
    solver = MarkerSolver(dome_rig, sites)
    cleanup = clean_take(solver, take)
    solved = solver.solve_take(cleanup.filled)
    markers = cleanup.take.markers.values
    solution = Solution(dome_rig, solved, markers, sites, cleanup=cleanup)
    rmse = marker_rmse(dome_rig, sites, solved.weights.values[..., 0], markers)
    assert torch.equal(solution.rmse, rmse)
    report = SolveReport(solution, 0.9, 0.1, warnings=("M001 was never seen",))
    return write_solve_page(tmp_path_factory.mktemp("report"), "take.c3d", report)


def test_the_face_plays_and_stands_in_pictures(page: Path) -> None:
    text = page.read_text()
    assert text.index("M001 was never seen") < text.index("<h2>The performance</h2>")
    for name in re.findall(r'src="([^"]+)"', text):
        assert (page.parent / name).stat().st_size > 1000, name
    assert {"player.js", "performance.js", "frames.png", "marker_map.png"} <= set(re.findall(r'src="([^"]+)"', text))


def test_the_worst_marker_comes_first_with_its_constant_part(page: Path) -> None:
    table = page.read_text().split("<h2>Error of each marker</h2>")[1].split("<h2>")[0]
    first = re.findall(r"<td>(.*?)</td>", table)[:5]
    assert first[0] == "M008"
    rmse, constant = (float(cell.split()[0]) for cell in first[1:3])
    assert rmse > 2
    assert constant > 0.9 * rmse
    rows = [float(row.split()[0]) for row in re.findall(r"<tr><td>M\d+</td><td>(.*?)</td>", table)]
    assert len(rows) == 30
    assert rows == sorted(rows, reverse=True)


def test_swaps_stand_before_spikes_and_gaps_are_summed_up(page: Path) -> None:
    wrong = page.read_text().split("What was wrong with the take</h2>")[1]
    row = "<tr><td>M004 ↔ M021</td><td>530–549</td><td>0.83</td>"
    assert row in wrong
    assert wrong.split(row)[1].split("</tr>")[0].count("<td>") == 2  # distance, done
    assert wrong.index("M004 ↔ M021") < wrong.index("<th>Spikes</th>") < wrong.index("gaps of")
    gaps = wrong.split("<details>")[1]
    assert re.search(r"<summary>\d+ gaps, \d+ of them filled, by marker</summary>", gaps)
    assert len(re.findall(r"<tr><td>M", gaps.split("</details>")[0])) <= 30  # a marker a row, however many gaps
