"""The main job end to end: what it writes is what it solved, and what it solved is close to the truth."""

import html
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, Mesh, load_rig, load_take, save_mesh, save_rig
from torchface.capture import MarkerSolver
from torchface.errors import TopologyError, ValueRangeError
from torchface.onnx import SolverReport
from torchface.synthetic.head.embedded_character import shown_rig
from torchface.workflows.demo.demo_page import result_rows, scene_rows, write_demo_page
from torchface.workflows.demo.run_demo import FLAWS, embedded_scene, run_demo, scene_from


@pytest.fixture(autouse=True)
def small_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchface.workflows.demo.run_demo.shown_rig", partial(shown_rig, size=256))


@pytest.mark.usefixtures("coarse_figures")
def test_the_embedded_performer_comes_back_and_every_file_says_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[MarkerSolver] = []

    def exported(solver: MarkerSolver, path: Path, markers: torch.Tensor, progress: object) -> SolverReport:
        """In place of twenty seconds of ``torch.export``."""
        asked.append(solver)
        return SolverReport(path, path.write_bytes(bytes(9)), None, 1, 1, (), 0.0, 0.0)

    monkeypatch.setattr("torchface.workflows.demo.run_demo.export_marker_solver", exported)
    scene, some = embedded_scene(seed=4, frames=80), slice(None, None, 2)  # with half of the shapes, in half the time
    template, truth = (rig.select(rig.names[some]) for rig in (scene.template, scene.truth))
    scene = replace(scene, template=template, truth=truth, weights=scene.weights[:, some])
    result = run_demo(scene, tmp_path, seed=4)
    noise = 3**0.5 * FLAWS.noise
    solved, single = result.solved, result.frame_by_frame
    for one in (solved, single):
        assert 0.8 * noise < float(one.marker_rmse.nanmedian()) < 1.1 * noise
        assert one.mesh_error.mean < 0.3
        assert one.mesh_error.relative < 0.3
    assert solved.mesh_error.mean < 0.85 * single.mesh_error.mean
    assert solved.jitter < 2 < single.jitter
    assert solved.correlation > single.correlation
    assert solved.correlation > 0.9

    rig = load_rig(result.files["transferred rig"])
    torch.testing.assert_close(rig.vertices, result.scene.head.vertices, atol=1e-3, rtol=0)
    take = load_take(result.files["marker take"])
    again = MarkerSolver(rig, result.attachment).solve_take(take).weights
    torch.testing.assert_close(again.values[..., 0].float(), single.weights, atol=5e-3, rtol=0)
    written = load_take(result.files["solved weights"]).weights
    torch.testing.assert_close(rig.weights_from(written).float(), solved.weights, atol=1e-5, rtol=0)

    (solver,) = asked
    assert solver.names == result.rig.names
    assert solver.labels == result.attachment.labels
    assert result.solver.path == result.files["solver for applications"]

    page = write_demo_page(result, tmp_path)
    text = page.read_text()
    for name in re.findall(r'src="([^"]+)"', text):
        assert (tmp_path / name).stat().st_size > 1000
    for what, *_ in [*result_rows(result), *scene_rows(result)]:
        assert html.escape(what) in text
    assert len(re.findall(r"[.] ", re.findall(r"<p>(.*?)</p>", text)[0])) == 0  # the story is one sentence


@pytest.mark.bench
def test_a_rig_without_landmarks_and_names_gets_markers_where_it_moves(tmp_path: Path) -> None:
    scene = embedded_scene(seed=1, frames=20)
    some = slice(None, None, 4)

    def nameless(rig: BlendshapeRig) -> BlendshapeRig:
        deltas = rig.deltas[some]
        return BlendshapeRig(replace(rig.neutral, annotations=None), deltas, [f"shape{i}" for i in range(len(deltas))])

    truth = nameless(scene.truth)
    few = replace(
        scene, template=nameless(scene.template), head=truth.neutral, truth=truth, weights=scene.weights[:, some]
    )
    result = run_demo(few, tmp_path)
    assert result.layout is None
    assert len(result.attachment.triangles) == 100
    assert "neither 68 landmarks nor" in write_demo_page(result, tmp_path).read_text()


def test_parts_that_do_not_fit_are_named(tmp_path: Path) -> None:
    run_scene = embedded_scene(seed=1, frames=2)
    save_rig(run_scene.template, tmp_path / "template.glb")
    square = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))
    save_mesh(square, tmp_path / "square.obj")
    with pytest.raises(ValueRangeError, match=r"template.glb: found no identity modes"):
        scene_from(tmp_path / "template.glb", None, None, 1)
    with pytest.raises(TopologyError, match="target: found Mesh"):
        scene_from(tmp_path / "template.glb", None, tmp_path / "square.obj", 1)


@pytest.mark.bench
@pytest.mark.real
def test_a_real_take_moves_a_random_real_head(ict_folder: Path, performances: list[Path]) -> None:
    scene = scene_from(ict_folder, performances[0], None, seed=3)
    assert scene.weights.shape == (1846, 53)
    assert (scene.head.vertices - scene.template.vertices).norm(dim=1).mean() > 1.0
    assert torch.equal(scene.truth.deltas, scene.template.deltas)
