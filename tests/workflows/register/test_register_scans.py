"""A corpus is registered as its scans one by one would be, whatever is bad among them and whenever it is killed."""

import csv
import json
import multiprocessing
import os
import pickle
import random
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface.errors import FileFormatError, MissingExtraError, ShapeError, TopologyError, ValueRangeError
from torchface.files import content_keys
from torchface.io import Correspondences, load_image, load_mesh, save_correspondences, save_mesh
from torchface.mesh import Annotations, Mesh
from torchface.registration import Level, Schedule, Stage, load_scan_landmarks, register
from torchface.registration.model_fit import LinearShape
from torchface.workflows.batch.batch_items import BatchItem, find_items
from torchface.workflows.batch.batch_job import picture_path
from torchface.workflows.batch.run_batch import BatchOptions, BatchReport
from torchface.workflows.register.register_scans import SCANS, ScanSettings, register_scans
from torchface.workflows.register.scan_job import ScanJob

SHORT = Schedule((Stage(Level.GRAPH, 8.0, 8.0, 20.0, samples=300), Stage(Level.GRAPH, 0.5, 1.0, 8.0)), nodes=30)
COUNT = 5


@pytest.fixture(scope="module")
def template(make_mask: Callable[[int, int], Mesh]) -> Mesh:
    return make_mask(17, 23)


@pytest.fixture(scope="module")
def scans(
    template: Mesh,
    warp: Callable[[torch.Tensor], torch.Tensor],
    moved: Callable[..., torch.Tensor],
    rescanned: Callable[..., Mesh],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A folder of scans in random poses with LJSON landmarks beside them, and ``bad.ply``, which is none."""
    folder = tmp_path_factory.mktemp("scans")
    for i in range(COUNT):
        true = moved(warp(template.vertices), i)
        save_mesh(rescanned(template.with_vertices(true), i), folder / f"s{i}.ply")
        points = {"points": true[template.landmarks].tolist()}
        (folder / f"s{i}.ljson").write_text(json.dumps({"version": 2, "labels": [], "landmarks": points}))
    (folder / "bad.ply").write_bytes(b"junk")
    return folder


def run(template: Mesh, scans: Path, out: Path, **more: object) -> BatchReport:
    return register_scans(template, [scans], out, ScanSettings(landmarks=scans, schedule=SHORT, texture_size=0), **more)


@pytest.fixture(scope="module")
def done(template: Mesh, scans: Path, tmp_path_factory: pytest.TempPathFactory) -> BatchReport:
    return run(template, scans, tmp_path_factory.mktemp("done"))


def test_each_result_is_what_register_gives_for_that_scan(template: Mesh, scans: Path, done: BatchReport) -> None:
    assert [entry.name for entry in done.done] == [f"s{i}" for i in range(COUNT)]
    for entry in done.done[:2]:
        assert entry.results
        landmarks = load_scan_landmarks(scans / f"{entry.name}.ljson", template, entry.item.path)
        alone = register(template, load_mesh(entry.item.path), landmarks, schedule=SHORT)
        found = load_mesh(entry.results[0])
        torch.testing.assert_close(found.vertices.double(), alone.mesh.vertices, atol=2e-4, rtol=0)
        assert torch.equal(found.faces, template.faces)
        assert torch.equal(found.landmarks, template.landmarks)
        picture = load_image(picture_path(done.out, entry.item))
        assert picture.shape[1:] == (3 * 400 + 2 * 4, 320)
        green = (picture[1] > 0.6) & (picture[[0, 2]] < 0.3).all(0)
        assert int(green[:400].sum()) > 2 * len(template.landmarks)
        assert entry.figures["median_mm"] == pytest.approx(alone.record.median_distance, rel=1e-6)


def test_a_scan_with_the_templates_triangles_is_taken_as_it_is(
    template: Mesh, warp: Callable[[torch.Tensor], torch.Tensor], tmp_path: Path
) -> None:
    save_mesh(template, tmp_path / "template.ply")
    template = load_mesh(tmp_path / "template.ply")
    (tmp_path / "scans").mkdir()
    head = template.with_vertices(warp(template.vertices))
    save_mesh(head, tmp_path / "scans" / "head.ply")
    save_mesh(head.with_vertices(0.1 * head.vertices), tmp_path / "scans" / "small.ply")
    report = register_scans(template, [tmp_path / "scans"], tmp_path / "out", ScanSettings(schedule=SHORT))
    made, small = sorted(report.outcomes, key=lambda outcome: outcome.name)
    assert made.figures["start"] == "its triangles"
    assert any("taken as it is" in note for note in made.notes)
    assert "in centimetres" in small.error
    torch.testing.assert_close(load_mesh(tmp_path / "out" / "head.glb").vertices, head.vertices, atol=1e-3, rtol=0)


def test_a_loose_part_that_the_scan_does_not_show_keeps_the_templates_colours(
    template: Mesh, rescanned: Callable[..., Mesh], tmp_path: Path
) -> None:
    """As hair and a shirt of a character do: the scan's colours were spread over them."""
    scan = rescanned(template, 0)
    save_mesh(replace(scan, colors=torch.full_like(scan.vertices, 0.5).float()), tmp_path / "grey.ply")
    count = len(template.vertices)
    part = torch.tensor([[0.0, 0, -400], [10, 0, -400], [0, 10, -400], [0, 0, -410]]).to(template.vertices)
    faces = count + torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    colors = torch.cat([torch.full((count, 3), 0.7), torch.tensor([0.1, 0.2, 0.9]).expand(4, 3)])
    whole = Mesh(
        torch.cat([template.vertices, part]),
        torch.cat([template.faces, faces]),
        colors=colors,
        annotations=Annotations(landmarks=template.landmarks),
    )
    points = tmp_path / "grey.ljson"
    listed = template.vertices[template.landmarks].tolist()
    points.write_text(json.dumps({"version": 2, "labels": [], "landmarks": {"points": listed}}))
    settings = ScanSettings(landmarks=points, schedule=SHORT, texture_size=0)
    report = register_scans(whole, [tmp_path / "grey.ply"], tmp_path / "out", settings)
    found = load_mesh(report.done[0].results[0])
    torch.testing.assert_close(found.colors[count:], colors[count:], atol=0.01, rtol=0)
    assert float((found.colors[:count] - 0.5).abs().median()) < 0.02
    left_out = replace(settings, colors=False)
    notes = " ".join(register_scans(whole, [tmp_path / "grey.ply"], tmp_path / "clay", left_out).done[0].notes)
    assert "without colours hair cannot be distinguished from skin" in notes
    assert "the scan has neither a texture" not in notes


def test_bad_scans_are_told_and_skipped(scans: Path, done: BatchReport) -> None:
    assert [entry.name for entry in done.skipped] == ["bad"]
    assert "bad.ply" in done.skipped[0].error
    with done.summary.open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert len(rows) == COUNT + 1
    assert rows["bad"]["status"] == "skipped"
    assert "no PLY header" in rows["bad"]["remarks"]
    assert float(rows["s0"]["median_mm"]) == pytest.approx(done.done[0].figures["median_mm"], abs=1e-4)
    record = json.loads((done.out / "records" / "s0.json").read_text())
    assert record["details"]["stages"][0]["stiffness"] == 8.0


def test_a_run_killed_at_random_moments_leaves_whole_files_and_goes_on(
    template: Mesh, scans: Path, done: BatchReport, tmp_path: Path
) -> None:
    # A server that has loaded the library forks each run: a second's work a kill instead of ten.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchface.workflows.register.register_scans"])
    out, chance = tmp_path / "out", random.Random(0)
    kept: dict[str, int] = {}
    kills = 0
    settings = {"settings": ScanSettings(landmarks=scans, schedule=SHORT, texture_size=0)}
    for number in range(1, 7):
        process = context.Process(target=register_scans, args=(template, [scans], out), kwargs=settings)
        process.start()
        limit = time.monotonic() + 60
        while not (out / ".lock").exists() and process.is_alive() and time.monotonic() < limit:
            time.sleep(0.01)
        process.join(chance.uniform(0.02, 0.2 * number))
        if process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.join()
        for record in out.glob("records/*.json"):
            told = json.loads(record.read_text())
            if told["status"] == "done":
                assert len(load_mesh(out / next(iter(told["results"]))).vertices) == len(template.vertices)
        for result in out.glob("*.glb"):
            load_mesh(result)
        for name, when in kept.items():
            assert (out / name).stat().st_mtime_ns == when  # what was finished is not made again
        kept = {path.with_suffix(".glb").name: 0 for path in out.glob("records/s*.json")}
        kept = {name: (out / name).stat().st_mtime_ns for name in kept}
    assert kills >= 2
    end = run(template, scans, out)
    assert [entry.name for entry in end.done] == [entry.name for entry in done.done]
    assert sum(entry.reused for entry in end.outcomes) >= len(kept)
    assert not list(out.glob(".*.part"))
    for entry, whole in zip(end.done, done.done, strict=True):
        assert entry.results
        assert whole.results
        torch.testing.assert_close(
            load_mesh(entry.results[0]).vertices, load_mesh(whole.results[0]).vertices, atol=1e-3, rtol=0
        )


def test_scans_of_one_name_get_results_of_different_names(template: Mesh, scans: Path, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same.ply").write_bytes(b"junk")
    (tmp_path / "b" / "same.obj").write_bytes(b"junk")
    report = register_scans(template, [tmp_path / "a", tmp_path / "b", tmp_path / "missing.ply"], tmp_path / "out")
    names = [entry.name for entry in report.outcomes]
    assert len(set(names)) == 4
    assert names[-1] == "missing"
    assert "no such file" in report.outcomes[-1].error


def test_landmarks_of_the_only_scan_come_as_its_file(template: Mesh, scans: Path, tmp_path: Path) -> None:
    settings = ScanSettings(landmarks=scans / "s0.ljson", schedule=SHORT, texture_size=0)
    (entry,) = register_scans(template, [scans / "s0.ply"], tmp_path / "one", settings).done
    assert entry.figures["start"] == "landmarks"
    with pytest.raises(FileFormatError, match=r"landmarks: found no folder .*s0.ljson"):
        register_scans(template, [scans], tmp_path / "many", settings)
    with pytest.raises(FileFormatError, match=r"found no file of a scan's name .*such as bad.ljson"):
        register_scans(template, [scans], tmp_path / "many", ScanSettings(landmarks=tmp_path))


def test_landmarks_come_as_points_in_the_templates_order_or_as_correspondences(template: Mesh, tmp_path: Path) -> None:
    points = template.vertices[template.landmarks] + 3
    rows = "\n".join(" ".join(f"{x:.6f}" for x in row) for row in (points / 10).tolist())
    (tmp_path / "a.pts").write_text(f"version: 1\nn_points: {len(points)}\n{{\n{rows}\n}}\n")
    ids, found = load_scan_landmarks(tmp_path / "a.pts", template, "scan.ply", unit="cm")
    assert torch.equal(ids, template.landmarks)
    torch.testing.assert_close(found, points, atol=1e-4, rtol=0)
    labels = tuple("abc")
    pairs = Correspondences(torch.tensor([5, 1, 9]), points[:3], labels, template.fingerprint())
    save_correspondences(pairs, tmp_path / "a.json")
    ids, found = load_scan_landmarks(tmp_path / "a.json", template, "scan.glb")
    assert ids.tolist() == [5, 1, 9]
    torch.testing.assert_close(found, points[:3])
    (tmp_path / "few.ljson").write_text(json.dumps({"version": 2, "landmarks": {"points": points[:4].tolist()}}))
    with pytest.raises(ShapeError, match="found 4 points, expected the template's 8"):
        load_scan_landmarks(tmp_path / "few.ljson", template, "scan.ply")
    with pytest.raises(TopologyError, match="made for a mesh with other triangles"):
        load_scan_landmarks(tmp_path / "a.json", Mesh(template.vertices, template.faces[:-1]), "scan.ply")
    with pytest.raises(ValueRangeError, match="without annotated landmarks"):
        load_scan_landmarks(tmp_path / "a.pts", Mesh(template.vertices, template.faces), "scan.ply")


def test_mistakes_are_told_before_anything_is_done(
    template: Mesh, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileFormatError, match="found no scan in the folder"):
        find_items([tmp_path / "empty"], SCANS)
    with pytest.raises(FileFormatError, match="none named"):
        register_scans(template, [], tmp_path / "out")
    with pytest.raises(FileFormatError, match="cannot be made"):
        register_scans(template, [scans], tmp_path / "file" / "out")
    with pytest.raises(ValueRangeError, match="which holds scans"):
        register_scans(template, [scans], scans)
    with pytest.raises(TopologyError, match="template: found 0 triangles"):
        register_scans(Mesh(template.vertices, template.faces[:0]), [scans], tmp_path / "out")
    with pytest.raises(ValueRangeError, match="jobs: found 0"):
        register_scans(template, [scans], tmp_path / "out", options=BatchOptions(0))
    with pytest.raises(FileFormatError, match="landmarks: found no folder"):
        register_scans(template, [scans], tmp_path / "out", ScanSettings(landmarks=tmp_path / "none"))
    assert not (tmp_path / "out").exists()
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"-m pip install 'ray>=2.40'"):
        register_scans(template, [scans], tmp_path / "out", options=BatchOptions(cluster="auto"))


def test_every_input_is_in_the_key(template: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes, count = template.annotations, len(template.vertices)
    scan, marks = tmp_path / "scans" / "a.obj", tmp_path / "marks"
    for folder in (scan.parent, marks, tmp_path / "detector"):
        folder.mkdir()
    files = {
        scan: "mtllib other.mtl\nv 0 0 0\n",
        scan.parent / "other.mtl": "newmtl skin\nmap_Kd -clamp on skin.png\n",
        scan.parent / "skin.png": "pixels",
        scan.parent / "a.png": "beside",
        marks / "a.ljson": "{}",
        tmp_path / "detector" / "model.toml": "kind",
    }
    for path, text in files.items():
        path.write_text(text)
    job = ScanJob(template, SHORT, 0, marks, detector=tmp_path / "detector")

    def key(job: ScanJob) -> str:
        return replace(job).key(BatchItem("a", scan))  # a fresh one: it lists each folder once

    shape = LinearShape(template.vertices, torch.zeros(1, count, 3))
    jobs = [
        job,
        replace(job, template=template.with_vertices(template.vertices + 1e-4)),
        replace(job, template=replace(template, annotations=replace(notes, contacts=torch.tensor([[0, 5]])))),
        replace(job, template=replace(template, annotations=replace(notes, mirror=torch.arange(count)))),
        replace(job, template=replace(template, annotations=replace(notes, regions={"a": torch.ones(count) > 0}))),
        replace(job, template=replace(template, annotations=replace(notes, landmarks=template.landmarks.flip(0)))),
        replace(job, schedule=replace(SHORT, nodes=31)),
        replace(job, texture_size=64),
        replace(job, unit="cm"),
        replace(job, detector=None),
        replace(job, model=shape),
        replace(job, model=replace(shape, modes=shape.modes + 1)),
    ]
    keys = [key(job) for job in jobs]
    assert pickle.loads(pickle.dumps(job)).key(BatchItem("a", scan)) == keys[0]  # as processes of their own get it
    keys.append(key(replace(job, landmarks=None)))
    for path, text in files.items():  # none of another size or date
        state = path.stat()
        path.write_text(text[:-2] + "?\n" if text.endswith("\n") else text[:-1] + "?")
        os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
        keys.append(key(job))
        path.write_text(text)
        os.utime(path, (5, 5))
        assert key(job) == keys[0]
    monkeypatch.setattr(content_keys, "__version__", "0.0.0")
    keys.append(key(job))
    assert len(set(keys)) == len(keys)
