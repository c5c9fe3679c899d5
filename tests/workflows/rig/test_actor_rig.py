"""From scans on disk to an actor's rig on disk: what was planted comes back."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from torchface import BlendshapeRig, Mesh, load_rig, save_mesh, save_rig, zoo
from torchface.cli import main
from torchface.errors import AlignmentError, FileFormatError, TopologyError, ValueRangeError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.io import Correspondences, load_detail_maps, save_correspondences
from torchface.modeling import MorphableModel, transfer_deformation
from torchface.registration import Registration, hidden_parts, in_place_of, with_template_skin
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.synthetic import neutral_head, performer
from torchface.workflows.rig import actor_rig
from torchface.workflows.rig.actor_report import ActorReport
from torchface.workflows.rig.actor_rig import RigOptions, rig_actor

PICKS = torch.arange(26, 600, 41)


@dataclass(frozen=True, eq=False)
class Actor:
    """A folder with template and scans, and the rig that the scans were taken of."""

    folder: Path
    true: BlendshapeRig


def write_scan(mesh: Mesh, path: Path, seed: int, template: Mesh | None = None) -> None:
    """The surface in another topology and place, with noise, and picked correspondences beside it."""
    generator = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=generator).as_matrix(), generator.normal(0, 50, 3)
    fine, faces = trimesh.remesh.subdivide(mesh.vertices.double().numpy(), mesh.faces.numpy())
    fine, faces = trimesh.remesh.subdivide(fine, faces)
    order = generator.permutation(len(fine))
    placed = (fine @ turn.T + shift + generator.normal(0, 0.02, fine.shape))[order]
    save_mesh(Mesh(torch.from_numpy(placed).float(), torch.from_numpy(np.argsort(order)[faces].astype(np.int64))), path)
    if template is not None:
        points = mesh.vertices[PICKS].double() @ torch.from_numpy(turn).T + torch.from_numpy(shift)
        labels = tuple(str(i) for i in PICKS.tolist())
        pairs = Correspondences(PICKS, points, labels, template.fingerprint())
        save_correspondences(pairs, path.with_suffix(".json"))


@pytest.fixture(scope="module")
def actor(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Actor:
    folder = tmp_path_factory.mktemp("actor")
    for name in ("examples", "detail"):
        (folder / name).mkdir()
    x, y, z = dome_rig.vertices.unbind(-1)
    uvs = torch.stack([x, y], dim=-1) / 104 + 0.5
    mesh = replace(dome_rig.neutral, uvs=uvs, uv_faces=dome_rig.neutral.faces)
    template = BlendshapeRig(mesh, dome_rig.deltas, dome_rig.names)
    save_rig(template, folder / "template.glb")
    vertices = torch.stack([x * 1.06, y * 0.95, z + 3 * torch.exp(-(x**2 + (y + 20) ** 2) / 300)], dim=-1)
    # The person opens the jaw further, and more to one side, than the template would.
    deltas = dome_rig.deltas.clone()
    deltas[0] = deltas[0] * 1.6 + torch.tensor([1.5, 0, 0]) * deltas[0].norm(dim=-1, keepdim=True) / 6
    true = BlendshapeRig(mesh.with_vertices(vertices), deltas, dome_rig.names)
    write_scan(true.neutral, folder / "neutral.ply", 1, mesh)
    pose = true.neutral.with_vertices(true.vertices + true.deltas[0])
    write_scan(pose, folder / "examples" / "jawOpen.ply", 2, mesh)
    write_scan(pose, folder / "detail" / "jawOpen.ply", 3)
    write_scan(true.neutral, folder / "detail" / "neutral.ply", 4)
    return Actor(folder, true)


def inner_error(found: BlendshapeRig, true: BlendshapeRig) -> tuple[float, float]:
    """Root mean square error of the neutral once aligned to the truth, and of jawOpen, away from the border."""
    inside = (true.vertices[:, :2].abs() < 42).all(-1)
    own = found.vertices[inside].double()[None]
    pose = similarity_transform(own, true.vertices[inside].double()[None], scale=False)
    neutral = (pose.apply(own)[0] - true.vertices[inside]).square().sum(-1).mean().sqrt()
    jaw = (found.deltas[0].double() @ pose.rotation[0].T - true.deltas[0])[inside].square().sum(-1).mean().sqrt()
    return float(neutral), float(jaw)


def test_the_command_brings_the_planted_rig_back(actor: Actor, capsys: pytest.CaptureFixture[str]) -> None:
    folder = actor.folder
    words = [folder / "neutral.ply", "--template", folder / "template.glb", "--landmarks", folder / "neutral.json"]
    main(["rig", *map(str, words), "--out", str(folder / "new" / "plain.glb"), "--quiet"])
    words += ["--examples", folder / "examples", "--detail", folder / "detail", "--detail-size", "64"]
    main(["rig", *map(str, words), "--out", str(folder / "actor.glb"), "--quiet"])
    told = " ".join(capsys.readouterr().err.split())
    for fact in (
        "aligned with the scan by landmarks",
        "of the template's outer side",
        "_registration.png",
        "4 shapes transferred",
        "examples: 1",
        "normal maps: 2",
    ):
        assert fact in told
    assert (folder / "actor_registration.png").is_file()
    plain, learned = load_rig(folder / "new" / "plain.glb"), load_rig(folder / "actor.glb")
    assert learned.names == actor.true.names
    assert torch.equal(learned.neutral.faces, actor.true.neutral.faces)
    neutral, transferred = inner_error(plain, actor.true)
    assert neutral < 0.5
    # With the true meshes in place of scans, one example takes 42 % of the error away: the rest the prior holds.
    assert inner_error(learned, actor.true)[1] < 0.8 * transferred
    maps = load_detail_maps(folder / "actor.glb")
    assert maps.names == ("jawOpen",)
    assert maps.maps.shape == (1, 3, 64, 64)
    assert maps.neutral is not None


def rig_folder(actor: Actor, out: Path, *more: str) -> list[str]:
    """Rigs a folder of the actor's scan, a damaged one and a video by the command; the names of what comes of it."""
    scans = out.parent / "scans"
    scans.mkdir(exist_ok=True)
    for name in ("neutral.ply", "neutral.json"):
        (scans / name).write_bytes((actor.folder / name).read_bytes())
    (scans / "torn.ply").write_bytes((scans / "neutral.ply").read_bytes()[:5000])
    (scans / "film.mp4").write_text("x")
    words = [scans, "--template", actor.folder / "template.glb", "--landmarks", scans, "--out", out, *more]
    with pytest.raises(SystemExit) as ended:
        main(["rig", *map(str, words)])
    assert ended.value.code == 1
    return sorted(path.name for path in out.iterdir())


def test_a_folder_of_actors_is_rigged_as_each_alone(
    actor: Actor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = rig_folder(actor, tmp_path / "rigs")
    told = " ".join(capsys.readouterr().err.split())
    assert "1 of 2 scans rigged" in told
    assert "left out 1 video" in told
    assert "torn: " in told
    assert found == ["contact_sheet.png", "neutral.glb", "neutral_registration.png", "records", "summary.csv"]
    files = (actor.folder / "neutral.ply", actor.folder / "template.glb", tmp_path / "neutral.glb")
    rig_actor(*files, actor.folder / "neutral.json")
    assert files[2].read_bytes() == (tmp_path / "rigs" / "neutral.glb").read_bytes()


def test_a_model_of_heads_holds_the_sliding(actor: Actor, tmp_path: Path) -> None:
    template = load_rig(actor.folder / "template.glb")
    to_actor = actor.true.vertices - template.vertices
    people = torch.linspace(-1.5, 1.5, 5)[:, None, None] * to_actor + template.vertices
    model = MorphableModel.fit(people, 1)
    zoo.save_model(model, tmp_path / "people", zoo.ModelCard("MIT", "planted", {}, "none"))
    files = (
        actor.folder / "neutral.ply",
        actor.folder / "template.glb",
        tmp_path / "a.glb",
        actor.folder / "neutral.json",
    )
    plain, held = (
        inner_error(rig_actor(*files, options=RigOptions(model=name)).rig, actor.true)[0]
        for name in (None, tmp_path / "people")
    )
    assert held < 0.6 * plain
    with pytest.raises(ValueRangeError, match="beside a model of heads at rest"):
        rig_actor(*files, options=RigOptions(model=tmp_path / "people", pose={"jawOpen": 1.0}))


def test_a_neutral_scanned_in_a_pose_is_brought_back_to_rest(actor: Actor, tmp_path: Path) -> None:
    shown = actor.true.neutral.with_vertices(actor.true.vertices + actor.true.deltas[1])
    write_scan(shown, tmp_path / "up.ply", 5, actor.true.neutral)
    files = (tmp_path / "up.ply", actor.folder / "template.glb", tmp_path / "a.glb", tmp_path / "up.json")
    posed = rig_actor(*files, options=RigOptions(pose={"browInnerUp": 1.0}))
    left = rig_actor(*files)
    at_rest, as_scanned = (inner_error(one.rig, actor.true)[0] for one in (posed, left))
    assert at_rest < 0.5 * as_scanned


def test_a_head_with_the_templates_triangles_is_not_registered(actor: Actor, tmp_path: Path) -> None:
    save_mesh(actor.true.neutral, tmp_path / "head.obj")
    report = rig_actor(tmp_path / "head.obj", actor.folder / "template.glb", tmp_path / "head.glb")
    assert report.lines()[0].startswith("result: good, taken as it is")
    made = load_rig(tmp_path / "head.glb")
    truth = transfer_deformation(load_rig(actor.folder / "template.glb"), in_place_of(actor.true.neutral, made.neutral))
    torch.testing.assert_close(made.vertices, truth.vertices, atol=1e-3, rtol=0)
    torch.testing.assert_close(made.deltas, truth.deltas, atol=1e-2, rtol=0)


def test_what_every_example_shows_is_asked_of_the_neutral_scan(actor: Actor, tmp_path: Path) -> None:
    """Three that open the jaw and a neutral at rest: a question, which does not make the result worse."""
    head, examples, names = actor.true, tmp_path / "examples", actor.true.names
    examples.mkdir()
    save_mesh(head.neutral, tmp_path / "head.obj")
    for other in names[1:]:
        weights = torch.tensor([0.5 * (name == names[0]) + (name == other) for name in names])
        shown = head.neutral.with_vertices(head(weights[None])[0])
        save_mesh(shown, examples / f"{names[0]}=0.5+{other}.obj")
        report = rig_actor(tmp_path / "head.obj", actor.folder / "template.glb", tmp_path / "r.glb", examples=examples)
        asked = [line for line in report.lines() if f"every example shows {names[0]}=0.5; --pose" in line]
        assert len(asked) == (other == names[3])  # of one or two it is not asked
        assert report.lines()[0].startswith("result: good")


def test_bad_examples_are_skipped_and_none_that_serves_ends_it(actor: Actor, tmp_path: Path) -> None:
    (tmp_path / "mouthSmileLeft.ply").write_bytes(b"junk")
    files = (actor.folder / "neutral.ply", actor.folder / "template.glb", tmp_path / "a.glb")
    marks = actor.folder / "neutral.json"
    with pytest.raises(AlignmentError, match=r"none of 1 could be used; example mouthSmileLeft\.ply"):
        rig_actor(*files, marks, tmp_path)
    assert not (tmp_path / "a.glb").exists()
    for name in ("jawOpen.ply", "jawOpen.json"):
        (tmp_path / name).write_bytes((actor.folder / "examples" / name).read_bytes())
    report = rig_actor(*files, marks, tmp_path)
    assert report.example_names == ("jawOpen",)
    assert float(report.examples.errors[-1, 0]) < 0.7 * float(report.examples.errors[0, 0])
    assert "skipped: example mouthSmileLeft.ply" in report.lines()[-1]
    assert report.lines()[0] == report.verdict()
    assert report.verdict().startswith("result: partly usable, 95 % of what the scan shows lie within 0.")
    assert report.verdict().endswith("; 1 scan skipped")


def test_mistakes_are_told(actor: Actor, tmp_path: Path) -> None:
    scan, template, out = actor.folder / "neutral.ply", actor.folder / "template.glb", tmp_path / "a.glb"
    with pytest.raises(FileFormatError, match=r"expected \.glb"):
        rig_actor(scan, template, tmp_path / "a.obj")
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileFormatError, match="cannot be written"):
        rig_actor(scan, template, tmp_path / "file" / "a.glb")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="no scan of an expression"):
        rig_actor(scan, template, out, examples=tmp_path / "empty")
    with pytest.raises(FileFormatError, match=r"expected neutral\.obj and shapes"):
        rig_actor(scan, template, out, detail=tmp_path / "empty")
    (tmp_path / "jawOpen=0.5.ply").write_text("x")
    with pytest.raises(ValueRangeError, match="full strength"):
        rig_actor(scan, template, out, detail=tmp_path)
    with pytest.raises(FileFormatError, match=r"none\.ply"):
        rig_actor(tmp_path / "none.ply", template, out)
    other = neutral_head(texture=False)
    save_mesh(other, tmp_path / "other.ply")
    pairs = Correspondences(PICKS, torch.zeros(len(PICKS), 3), tuple(map(str, PICKS.tolist())), other.fingerprint())
    save_correspondences(pairs, tmp_path / "other.json")
    with pytest.raises(TopologyError, match=r"made for a mesh of \d+ vertices, expected"):
        rig_actor(scan, template, out, tmp_path / "other.json")


def test_hidden_eyeballs_and_the_mouth_keep_the_templates_skin_and_nothing_else_does() -> None:
    template = neutral_head(texture=False)
    count = len(template.vertices)
    white = replace(template, texture=torch.ones(3, 64, 64), colors=torch.ones(count, 3))
    black = replace(template, texture=torch.zeros(3, 128, 128), colors=torch.zeros(count, 3))
    everything = torch.ones(count, dtype=torch.bool)
    assert not hidden_parts(template, everything).any()
    hidden = hidden_parts(template, ~everything)
    assert 0 < int(hidden.sum()) < count / 2
    assert not hidden[template.landmarks].any()
    assert hidden[template.annotations.regions["mouth_interior"]].all()
    eyeball = template.annotations.regions["eyeball_left"]
    front = eyeball & (template.vertices[:, 2] > template.vertices[eyeball, 2].quantile(0.75))
    assert hidden_parts(template, front)[eyeball].all()  # a quarter of a part is no picture of it
    worn = with_template_skin(black, white, hidden)
    assert torch.equal(worn.colors[:, 0] == 1, hidden)
    # Texels under the corners of the face's triangles are still black, under the eyeballs' white.
    middles = template.uvs[template.uv_faces].mean(1)
    column, row = (middles[:, 0] * 128).long(), ((1 - middles[:, 1]) * 128).long()
    values = worn.texture[0, row.clamp(0, 127), column.clamp(0, 127)]
    of_hidden = hidden[template.faces].all(1)
    assert float(values[of_hidden].mean()) > 0.9
    assert float(values[~of_hidden].mean()) < 0.02
    assert with_template_skin(black, white, ~everything) is black


def test_what_is_drawn_of_a_registration_is_what_the_rig_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    template = performer(texture=False).select(["jawOpen"])
    notes, rest = template.neutral.annotations, template.vertices
    assert notes is not None
    balls = notes.regions["eyeball_left"] | notes.regions["eyeball_right"]
    through = rest + 15.0 * balls[:, None] * torch.tensor([0.0, 0.0, 1.0])  # before the lids
    pose = Similarity(torch.ones(1).double(), torch.eye(3).double()[None], torch.tensor([[5.0, 900.0, -40.0]]).double())
    shown = ~balls
    record = RegistrationRecord("shape", 0.0, (), (), 0.0, 1.0, 0.0)
    placed = template.neutral.with_vertices(pose.apply(through.double())[0].float())
    bent = Registration(placed, pose, shown.double(), shown, record)
    monkeypatch.setattr(actor_rig, "register", lambda *_, **__: bent)
    monkeypatch.setattr(actor_rig, "with_eye_note", lambda *given: given[2])
    drawn: list[Mesh] = []

    def sheet(_: Mesh, registration: Registration) -> torch.Tensor:
        drawn.append(registration.mesh)
        return torch.zeros(3, 4, 4)

    monkeypatch.setattr(actor_rig, "registration_sheet", sheet)
    save_rig(template, tmp_path / "template.glb")
    save_mesh(Mesh(rest, template.neutral.faces[1:]), tmp_path / "scan.obj")
    made = rig_actor(tmp_path / "scan.obj", tmp_path / "template.glb", tmp_path / "out.glb").rig
    assert float((made.vertices - rest)[balls].norm(dim=-1).max()) < 2
    seen = drawn[0].vertices - torch.tensor([5.0, 900.0, -40.0])
    assert float((seen - made.vertices).norm(dim=-1).max()) < 0.5


def test_details_for_a_file_without_a_place_for_them_are_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"detail maps .* for a \.ma file"):
        rig_actor(tmp_path / "no.obj", tmp_path / "no.glb", tmp_path / "a.ma", detail=tmp_path)


def test_the_report_names_the_shape_of_arkit_that_a_template_has_not() -> None:
    record = RegistrationRecord("shape", 1.0, (), (), 0.1, 1.0, 1.0)
    rig = performer(texture=False)
    report = ActorReport(rig, SimpleNamespace(record=record), "", None, (), {}, (), Path("a.png"))
    [line] = [line for line in report.lines() if line.startswith("rig: ")]
    assert line.endswith("51 shapes transferred; not of ARKit's 52: tongueOut (the template has no such shape)")
