"""Commands do on disk what the library does in memory, and say clearly what is wrong."""

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import onnx
import pytest
import torch
from displaced_sites import misplaced, site_distances

import torchface
from torchface.attachment import Attachment
from torchface.capture import MarkerSolver, WholeTakeSolver
from torchface.cli import COMMANDS, GROUPS, main
from torchface.evaluation import weight_jitter
from torchface.geometry.similarity import Similarity
from torchface.io import load_rig, load_take, save_animation, save_mesh, save_rig, save_take
from torchface.io.images.image_files import save_image
from torchface.io.landmarks.picks import LandmarkVertices, save_landmarks
from torchface.io.video import write_video
from torchface.io.weights.live_link_csv import save_live_link
from torchface.mesh import Mesh
from torchface.onnx import GraphSteps
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.synthetic.stages.marker_stage import StageFlaws, place_markers, record
from torchface.take import Take, Track
from torchface.workflows.attach.attach_markers import load_sites

WORDS = [
    *((name,) for name in COMMANDS),
    *((name, second) for name, group in GROUPS.items() for second in group.commands),
]
pytestmark = pytest.mark.usefixtures("coarse_figures")


@pytest.fixture
def shoot(dome_rig: BlendshapeRig, tmp_path: Path) -> Path:
    """A folder with a rig, an attachment and a take with gaps."""
    attachment = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(40)[:, None] / 7 + torch.arange(4))
    weights[0] = 0
    flaws = StageFlaws(noise=0.05, missing=0.1)
    recording = record(dome_rig, attachment, weights, torch.Generator().manual_seed(0), flaws)
    save_rig(dome_rig, tmp_path / "rig.glb")
    attachment.save(tmp_path / "attachment.json")
    save_take(recording.take, tmp_path / "take.c3d")
    torch.save(weights, tmp_path / "true.pt")
    return tmp_path


def run(*words: str | Path) -> None:
    main([str(word) for word in words])


def test_solve_writes_the_weights_that_the_solver_finds(shoot: Path, dome_rig: BlendshapeRig) -> None:
    out = shoot / "new folder" / "weights.csv"
    run("solve", shoot / "rig.glb", shoot / "take.c3d", "--attachment", shoot / "attachment.json", "--out", out)
    written = load_take(out).weights
    found = dome_rig.weights_from(written).float()
    torch.testing.assert_close(found, torch.load(shoot / "true.pt", weights_only=True), atol=0.06, rtol=0)
    solver, take = MarkerSolver(load_rig(shoot / "rig.glb"), place_markers(dome_rig, 30)), load_take(shoot / "take.c3d")
    smooth = WholeTakeSolver(solver).solve_take(take).weights
    torch.testing.assert_close(found, smooth.values[..., 0].float(), atol=1e-5, rtol=0)
    common = ("--attachment", shoot / "attachment.json", "--out", out, "--quiet")
    run("solve", shoot / "rig.glb", shoot / "take.c3d", *common, "--frame-by-frame")
    written, single = load_take(out).weights, solver.solve_take(take).weights
    frames = dome_rig.weights_from(written).float()
    torch.testing.assert_close(frames, single.values[..., 0].float(), atol=1e-5, rtol=0)
    assert weight_jitter(found) < weight_jitter(frames)


@pytest.mark.parametrize("words", [("--neutral-frame", "0", "--scale", "free"), ("--align", "--keep-rest")])
def test_solve_undoes_the_space_of_the_take(shoot: Path, dome_rig: BlendshapeRig, words: tuple[str, ...]) -> None:
    take, free = load_take(shoot / "take.c3d"), "free" in words
    angle = torch.tensor(0.7 * free)
    rotation = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]])
    space = Similarity(torch.tensor([1.1 if free else 1.0]), rotation[None], torch.tensor([[100.0, -900, 40]]))
    moved = Track(take.markers.names, space.apply(take.markers.values))
    save_take(Take(take.fps, markers=moved), shoot / "moved.c3d")
    out = shoot / "weights.csv"
    common = ("--attachment", shoot / "attachment.json", "--out", out, "--quiet")
    run("solve", shoot / "rig.glb", shoot / "moved.c3d", *common, *words)
    off = dome_rig.weights_from(load_take(out).weights).float() - torch.load(shoot / "true.pt", weights_only=True)
    assert float(off.abs().max() if free else off.abs().mean()) < (0.08 if free else 0.05)


def test_transfer_onto_the_own_neutral_writes_the_same_rig(shoot: Path, dome_rig: BlendshapeRig) -> None:
    save_mesh(dome_rig.neutral, shoot / "neutral.obj")
    run("transfer", shoot / "rig.glb", shoot / "neutral.obj", "--out", shoot / "actor.glb")
    torch.testing.assert_close(load_rig(shoot / "actor.glb").deltas, dome_rig.deltas, atol=5e-3, rtol=0)


def test_transfer_writes_arkits_names_and_a_folder_in_the_templates_order(
    shoot: Path, dome_rig: BlendshapeRig, messages_of: Callable[..., str]
) -> None:
    names = ["jawOpen", "browInnerUp_L", "browInnerUp_R", "wink"]
    save_rig(BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names), shoot / "halves.glb")
    save_mesh(dome_rig.neutral, shoot / "neutral.obj")
    assert "names: 2 of ARKit's 52; it has no wink" in messages_of(
        "transfer", shoot / "halves.glb", shoot / "neutral.obj", "--out", shoot / "actor", "--names", "arkit"
    )
    actor = load_rig(shoot / "actor")
    assert actor.names == ("jawOpen", "browInnerUp", "wink")
    merged = torch.stack([dome_rig.deltas[0], dome_rig.deltas[1] + dome_rig.deltas[2], dome_rig.deltas[3]])
    torch.testing.assert_close(actor.deltas, merged, atol=5e-3, rtol=0)
    assert torch.equal(actor.neutral.polygons, dome_rig.neutral.polygons)
    assert "expected .glb, .usd, .usda, .usdc, .usdz, .ma, or none for a folder" in messages_of(
        "transfer", shoot / "halves.glb", shoot / "neutral.obj", "--out", shoot / "actor.fbx", status=2
    )


def test_render_and_info_and_export(
    shoot: Path, capsys: pytest.CaptureFixture[str], messages_of: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run("render", shoot / "rig.glb", "--out", shoot / "a.png", "--height", "60", "--weights", "jawOpen=1", "--yaw", "0")
    run("render", shoot / "rig.glb", "--out", shoot / "b.png", "--height", "60", "--yaw", "0")
    assert (shoot / "a.png").read_bytes() != (shoot / "b.png").read_bytes()
    run("info", shoot / "rig.glb", "--attachment", shoot / "attachment.json")
    told = messages_of("info", shoot / "take.c3d")
    for fact in ("625", "jawOpen", "30 markers see 4 of 4", "40 at 60"):
        assert fact in told
    out = shoot / "solver.onnx"

    def exported(solver: MarkerSolver, path: Path, steps: GraphSteps, hybrid: bool, **_: object) -> Any:
        """In place of twenty seconds of ``torch.export``."""
        values = [
            onnx.helper.make_tensor_value_info(name, 1, [len(solver.labels), 3]) for name in ("markers", "weights")
        ]
        node = onnx.helper.make_node("Identity", ["markers"], ["weights"])
        opset = [onnx.helper.make_opsetid("", 18)]
        graph = onnx.helper.make_graph([node], "g", values[:1], values[1:])
        onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=9), path)
        rows = [(", ".join(solver.names), steps.method), ("hybrid", str(hybrid))]
        return SimpleNamespace(rows=lambda: rows, verdict=lambda: "result: good")

    monkeypatch.setattr("torchface.onnx.solver_graph_export.export_marker_solver", exported)
    given = ("--rig", shoot / "rig.glb", "--attachment", shoot / "attachment.json", "--out", out)
    run("export", "solver", *given)
    said = capsys.readouterr()
    assert "jawOpen, browInnerUp, mouthSmileLeft, mouthSmileRight" in said.out + said.err
    assert "splitting" in said.out + said.err
    assert "False" in said.out + said.err
    assert "markers (30" in messages_of("info", out)
    run("export", "solver", *given, "--hybrid")
    said = capsys.readouterr()
    assert "True" in said.out + said.err


def test_info_tells_of_the_animation_in_a_file(
    shoot: Path, dome_rig: BlendshapeRig, messages_of: Callable[..., str]
) -> None:
    values = torch.zeros(31, 4)
    values[:, 2], values[5, 0] = torch.linspace(0, 0.75, 31), 0.25
    take = Take(30.0, weights=Track(dome_rig.names, values[..., None]))
    save_animation(dome_rig, take, shoot / "moving.glb")
    told = messages_of("info", shoot / "moving.glb")
    assert "31 frames at 30 a second, 1.0 s" in told
    assert "mouthSmileLeft 0.75, jawOpen 0.25" in told
    assert "animation" not in messages_of("info", shoot / "rig.glb")


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"torchface {torchface.__version__}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("info", "nothing.glb"), "nothing.glb"),
        (("info", "nothing.xyz"), "nothing.xyz: found no such file"),
        (("render", "rig.glb", "--weights", "jawOpen"), "expected NAME=NUMBER"),
        (("solve", "rig.glb", "rig.glb", "--attachment", "attachment.json"), "rig.glb"),
        (("demo", "--template", "rig.glb", "--quiet"), "expected a target"),
        (("export", "solver", "--rig", "rig.glb", "--attachment", "take.c3d", "--out", "x.onnx"), "take.c3d"),
    ],
)
def test_mistakes_end_with_a_message_and_status_2(
    shoot: Path, words: tuple[str, ...], message: str, messages_of: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shoot)
    told = messages_of(*words, status=2)
    assert "error:" in told
    assert message in told.replace("\n", " ")


def test_a_demo_that_was_killed_is_said_to_begin_anew(
    shoot: Path, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    words = ["demo", "--template", str(shoot / "rig.glb"), "--out", str(tmp_path), "--quiet"]
    for name, said in (("nothing", False), ("template.glb", True), ("index.html", False)):
        (tmp_path / name).touch()
        assert ("begins anew" in messages_of(*words, status=2)) == said


def test_every_command_explains_itself_and_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    for words in WORDS:
        with pytest.raises(SystemExit) as ended:
            main([*words, "--help"])
        assert ended.value.code == 0
        told = capsys.readouterr().out
        assert len(told) > 500, words
        assert ("-q" in told) == ("--quiet" in told), words
        assert not re.search(r"\bNone\b", told), words  # Python's word, not the user's


def test_help_is_a_short_line_a_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    lines = [line.split(None, 1) for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    assert {line[0] for line in lines} == {*COMMANDS, *GROUPS, "train"}
    assert all(10 < len(line[1].strip()) < 90 for line in lines)


def test_an_attachment_without_a_rig_or_of_another_is_told_by_file(
    shoot: Path, dome_rig: BlendshapeRig, messages_of: Callable[..., str]
) -> None:
    save_mesh(dome_rig.neutral, shoot / "mesh.obj")
    save_mesh(dome_rig.neutral, shoot / "mesh.glb")
    for name, said in (("mesh.obj", "mesh.obj: found no rig"), ("mesh.glb", "found no morph target in its one mesh")):
        assert said in messages_of("info", shoot / name, "--attachment", shoot / "attachment.json", status=2)
    other = BlendshapeRig(Mesh(dome_rig.vertices, dome_rig.neutral.faces[:-1]), dome_rig.deltas, dome_rig.names)
    save_rig(other, shoot / "other.glb")
    files = (shoot / "other.glb", shoot / "take.c3d", "--attachment", shoot / "attachment.json")
    for words in (("info", files[0], *files[2:]), ("solve", *files, "--out", shoot / "out.csv")):
        said = messages_of(*words, status=2)
        assert "attachment.json: found marker sites made for a mesh with other triangles than" in said
        assert "other.glb, or the same in another order" in said


def test_solve_cleans_a_slipping_take_and_reports_it(
    shoot: Path, dome_rig: BlendshapeRig, messages_of: Callable[..., str]
) -> None:
    attachment = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(240)[:, None] / 9 + torch.arange(4))
    flaws = StageFlaws(noise=0.05, missing=0.02, slip_translation=6, slip_rotation=3)
    recording = record(dome_rig, attachment, weights, torch.Generator().manual_seed(0), flaws)
    values = recording.take.markers.values.clone()
    values[100:130, [3, 20]] = values[100:130, [20, 3]]
    save_take(Take(60.0, markers=Track(recording.take.markers.names, values)), shoot / "dirty.c3d")
    out, page = shoot / "weights.csv", shoot / "report"
    common = ("--attachment", shoot / "attachment.json", "--out", out, "--quiet")
    told = messages_of("solve", shoot / "rig.glb", shoot / "dirty.c3d", *common, "--slip", "--clean", "--report", page)
    assert "helmet or head: moved by up to" in told
    assert "swap M004 ↔ M021 100–129" in told
    html = (page / "index.html").read_text()
    assert "M004 ↔ M021" in html
    assert {path.name for path in page.glob("*.png")} >= {"error.png", "helmet.png", "weights1.png"}
    written = load_take(out).weights
    assert float((dome_rig.weights_from(written).float() - weights).abs().mean()) < 0.05


def test_attach_finds_the_sites_and_draws_them(
    shoot: Path, dome_rig: BlendshapeRig, capsys: pytest.CaptureFixture[str], messages_of: Callable[..., str]
) -> None:
    true = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(200)[:, None] * torch.tensor([0.08, 0.17, 0.25, 0.35]))
    recording = record(dome_rig, true, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.05))
    save_take(recording.take, shoot / "rom.c3d")
    guess = misplaced(dome_rig, true, torch.Generator().manual_seed(1), 2.0, 5.0)
    guess.save(shoot / "guess.json")
    out, picture = shoot / "sites.json", shoot / "sites.png"
    words = ("--initial", shoot / "guess.json", "--picture", picture, "--out", out)
    run("attach", shoot / "rig.glb", shoot / "rom.c3d", *words)
    found = Attachment.load(out)
    off = site_distances(dome_rig, found, true)
    assert off.mean() < 0.35 * site_distances(dome_rig, guess, true).mean()
    assert picture.stat().st_size > 10_000
    assert "30 markers over 200 frames" in capsys.readouterr().err
    # Labelled vertices, as picked, do as well as an attachment.
    ids = torch.cdist(guess.on(dome_rig.neutral.faces, dome_rig.vertices), dome_rig.vertices).argmin(1)
    save_landmarks(LandmarkVertices(ids, guess.labels or (), dome_rig.neutral.fingerprint()), shoot / "picks.json")
    assert torch.equal(
        load_sites(shoot / "picks.json", dome_rig.neutral).on(dome_rig.neutral.faces, dome_rig.vertices),
        dome_rig.vertices[ids],
    )
    assert "rom.c3d: " in messages_of(
        "attach", shoot / "rig.glb", shoot / "rom.c3d", "--initial", shoot / "rom.c3d", status=2
    )


def test_attach_takes_out_slip_and_swaps_and_writes_what_no_rig_explains_only_as_insisted(
    shoot: Path, dome_rig: BlendshapeRig, messages_of: Callable[..., str]
) -> None:
    true, out = place_markers(dome_rig, 20), shoot / "sites.json"
    weights = 0.5 + 0.5 * torch.sin(torch.arange(150)[:, None] * torch.tensor([0.08, 0.17, 0.25, 0.35]))
    slip = StageFlaws(noise=0.05, slip_translation=8, slip_rotation=3)
    markers = record(dome_rig, true, weights, torch.Generator().manual_seed(0), slip).take.markers
    values = markers.values.clone()
    values[60:90, [3, 17]] = markers.values[60:90, [17, 3]]
    values[:, 5] = torch.tensor([0.0, 40.0, 120.0]) + 30 * torch.sin(torch.arange(150)[:, None] / 9)
    save_take(Take(60.0, markers=Track(markers.names, values)), shoot / "dirty.c3d")
    misplaced(dome_rig, true, torch.Generator().manual_seed(1), 2.0, 5.0).save(shoot / "guess.json")
    words = ("attach", shoot / "rig.glb", shoot / "dirty.c3d", "--initial", shoot / "guess.json", "--out", out)
    words = (*words, "--scale", "free", "--quiet")  # held, it would also be tried off the skin, which takes as long
    assert re.search(r"dirty.c3d: markers: M006 .*--insist", messages_of(*words, status=2))
    assert not out.exists()
    said = messages_of(*words, "--insist")
    for part in ("warning: markers: M006", "helmet or head: moved by up to", "cleanup: 1 swap"):
        assert part in said
    off = site_distances(dome_rig, Attachment.load(out), true)
    assert (off > 0.5).nonzero().tolist() == [[5]]


@pytest.mark.parametrize(("word", "told"), [("sovle", "did you mean solve?"), ("xyz", "demo, register, rig,")])
def test_what_is_no_command_is_told_with_what_there_is(word: str, told: str, messages_of: Callable[..., str]) -> None:
    said = messages_of(word, "take.c3d", status=2)
    assert f"found the command '{word}', expected one: {told}" in said
    assert word != "xyz" or said.count("train") == said.count("zoo") == said.count("export") == 1


def test_info_tells_a_films_and_a_pictures_size(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    write_video([torch.zeros(10, 3, 32, 48, dtype=torch.uint8)], tmp_path / "film.avi", 20.0)
    save_image(torch.zeros(3, 20, 30), tmp_path / "photo.png")
    told = []
    for name in ("film.avi", "photo.png"):
        told.append(" ".join(messages_of("info", tmp_path / name).replace("│", "").split()))
    assert "frames 10 at 20 a second, 0.5 s" in told[0]
    assert "pixels 48 x 32" in told[0]
    assert "pixels 30 x 20" in told[1]


def test_weights_in_place_of_markers_are_told(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    save_live_link(Take(60.0, weights=Track(("jawOpen",), torch.zeros(5, 1, 1))), tmp_path / "take.csv")
    save_rig(performer(texture=False), tmp_path / "rig.glb")
    told = messages_of(
        "attach", tmp_path / "rig.glb", tmp_path / "take.csv", "--out", tmp_path / "sites.json", status=2
    )
    assert "found 52 weights, expected a marker take (.c3d, .trc, .csv); such weights go to another rig by" in told
