"""A template bent onto scans whose true correspondence is known."""

import math
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.meshes.operators import triangle_cross
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.io import load_identity_modes, load_landmark_points, load_mesh, load_rig
from torchface.mesh import Mesh
from torchface.registration import DEFAULT_SCHEDULE, Level, Registration, Schedule, Stage, register
from torchface.registration.scan_preparation import Landmarks
from torchface.synthetic import draw_identities, neutral_head


def error(result: Registration, truth: Tensor) -> Tensor:
    return (result.mesh.vertices.double() - truth.double()).norm(dim=1)


def turned_over(result: Registration, template: Mesh) -> int:
    """Triangles whose normal opposes that of the template aligned to the scan."""
    laid = result.pose.apply(template.vertices.double())[0]
    facing = triangle_cross(result.mesh.vertices.double(), template.faces) * triangle_cross(laid, template.faces)
    return int((facing.sum(-1) < 0).sum())


@pytest.fixture(scope="module")
def truth(mask: Mesh, warp, moved) -> Tensor:
    """Where the mask's vertices lie on another person, elsewhere."""
    return moved(warp(mask.vertices), 4)


@pytest.fixture(scope="module")
def scan(mask: Mesh, truth: Tensor, rescanned) -> Mesh:
    return rescanned(mask.with_vertices(truth))


@pytest.fixture(scope="module")
def landmarks(mask: Mesh, truth: Tensor) -> Landmarks:
    return mask.landmarks, truth[mask.landmarks]


@pytest.fixture(scope="module")
def registered(mask: Mesh, scan: Mesh, landmarks: Landmarks) -> Registration:
    return register(mask, scan, landmarks)


@pytest.fixture(scope="module")
def by_shape(mask: Mesh, scan: Mesh) -> Registration:
    return register(mask, scan)


@pytest.mark.parametrize("way", [(0.0, 0.0, 0.0), (0.0, 12.0, 0.0), (12.0, 0.0, 0.0)])
def test_landmarks_that_are_all_moved_alike_are_warned_of(way: tuple[float, ...]) -> None:
    """The mesh slides along the skin to where they are, and lies as near to the scan as without."""
    template = neutral_head(texture=False)
    somebody = neutral_head(draw_identities(1, torch.Generator().manual_seed(0))[0], texture=False)
    marks = (template.landmarks, somebody.vertices[somebody.landmarks] + torch.tensor(way))
    notes = register(template, somebody, marks, schedule=Schedule(DEFAULT_SCHEDULE.stages[:1])).record.notes
    said = [note for note in notes if "moved alike" in note]
    assert len(said) == bool(sum(way))
    for note in said:
        found = torch.tensor([float(part) for part in re.findall(r"-?[0-9]+", note.partition("about")[2])[:3]])
        assert float((found - torch.tensor(way)).norm()) < 3


def test_a_mesh_registered_to_itself_is_itself(mask: Mesh) -> None:
    result = register(mask, mask, (mask.landmarks, mask.vertices[mask.landmarks]))
    assert float(error(result, mask.vertices).max()) < 0.05
    assert float(error(register(mask, mask), mask.vertices).max()) < 0.1


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 0.9), (2, 1.15)])
def test_a_mesh_registered_to_a_moved_copy_is_the_copy(mask: Mesh, moved, seed: int, scale: float) -> None:
    copy = mask.with_vertices(moved(mask.vertices, seed, scale))
    result = register(mask, copy, (mask.landmarks, copy.vertices[mask.landmarks]))
    assert float(error(result, copy.vertices).max()) < 0.05
    assert float(result.pose.scale[0]) == pytest.approx(scale, abs=1e-3)


@pytest.mark.bench  # the mesh itself and a real head are found everyday
def test_without_landmarks_the_copy_is_found_too(mask: Mesh, moved) -> None:
    copy = mask.with_vertices(moved(mask.vertices, 3, 1.1))
    result = register(mask, copy)
    assert result.record.start == "shape"
    assert float(error(result, copy.vertices).max()) < 0.3


def beside_itself(mesh: Mesh) -> Mesh:
    apart = torch.tensor([500.0, 30.0, -40.0])
    return Mesh(
        torch.cat([mesh.vertices, mesh.vertices + apart]), torch.cat([mesh.faces, mesh.faces + len(mesh.vertices)])
    )


def test_a_second_head_on_the_scan_is_named(mask: Mesh) -> None:
    short, both = Schedule(DEFAULT_SCHEDULE.stages[:1]), beside_itself(mask)
    assert any("more than one place" in note for note in register(mask, both, schedule=short).record.notes)
    assert not any("more than one" in note for note in register(mask, mask, schedule=short).record.notes)


def test_a_planted_deformation_is_recovered(mask: Mesh, truth: Tensor, registered: Registration) -> None:
    """Where there is form or a landmark; the smooth outskirts can slide along themselves unseen, within limits."""
    rigid = (registered.pose.apply(mask.vertices)[0] - truth).norm(dim=1)
    bent = error(registered, truth)
    near = torch.cdist(mask.vertices, mask.vertices[mask.landmarks]).amin(1) < 15
    assert float(bent[near].mean()) < 0.2 * float(rigid[near].mean())
    assert float(bent.mean()) < 0.45 * float(rigid.mean())
    assert float(registered.distance[registered.matched].mean()) < 0.05
    assert registered.record.median_distance == pytest.approx(
        float(registered.distance[registered.matched].median()), abs=1e-9
    )


@pytest.mark.bench  # a peer
def test_the_full_system_of_the_paper_comes_to_the_same(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, truth: Tensor, registered: Registration
) -> None:
    stages = (
        Stage(Level.VERTICES, 18.0, 10.0, 30.0, iterations=4),
        Stage(Level.VERTICES, 5.0, 10.0, 20.0),
        Stage(Level.VERTICES, 1.2, 5.0, 12.0, iterations=2, contact_weight=2.0),
        Stage(Level.VERTICES, 0.3, 2.0, 8.0, iterations=2, contact_weight=2.0),
        Stage(Level.VERTICES, 0.2, 1.0, 5.0, iterations=2, contact_weight=2.0),
    )
    full = register(mask, scan, landmarks, schedule=Schedule(stages))
    assert float((full.mesh.vertices - registered.mesh.vertices).norm(dim=1).mean()) < 0.5
    assert float(error(registered, truth).mean()) < 1.15 * float(error(full, truth).mean())


def test_the_points_that_held_it_come_along(registered: Registration, by_shape: Registration, landmarks) -> None:
    assert all(map(torch.equal, registered.landmarks, (landmarks[0], landmarks[1].double())))
    assert len(by_shape.landmarks[0]) == 0


def test_no_triangle_turns_over(mask: Mesh, registered: Registration) -> None:
    assert turned_over(registered, mask) == 0


def test_the_same_input_gives_the_same_result(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, registered: Registration
) -> None:
    """The steps are told, and telling them changes nothing."""
    lines: list[str] = []
    again = register(mask, scan, landmarks, progress=lambda step, *_: lines.append(step))
    assert torch.equal(again.mesh.vertices, registered.mesh.vertices)
    assert again.record == registered.record
    assert sum("bending" in line for line in lines) == len(again.record.stages)
    assert lines[0] == "checking the head"


@pytest.mark.bench
def test_the_same_scan_without_landmarks_gives_the_same(mask: Mesh, scan: Mesh, by_shape: Registration) -> None:
    assert torch.equal(register(mask, scan).mesh.vertices, by_shape.mesh.vertices)


def test_the_energy_falls_in_every_linear_step(registered: Registration) -> None:
    steps = [pair for stage in registered.record.stages for pair in stage.energies]
    assert len(steps) >= len(registered.record.stages)
    assert all(after <= before * (1 + 1e-9) for before, after in steps)


def test_the_record_counts_every_correspondence(mask: Mesh, registered: Registration) -> None:
    stages = registered.record.stages
    assert [stage.stiffness for stage in stages] == sorted((s.stiffness for s in stages), reverse=True)
    assert stages[-1].distance < stages[0].distance
    assert stages[-1].used + sum(stages[-1].dropped.values()) == len(mask.vertices)
    assert registered.record.start == "landmarks"
    assert "stiffness" in str(registered.record)


def test_the_result_keeps_topology_coordinates_and_annotations(mask: Mesh, registered: Registration) -> None:
    result = registered.mesh
    assert torch.equal(result.faces, mask.faces)
    assert torch.equal(result.uvs, mask.uvs)
    assert torch.equal(result.landmarks, mask.landmarks)
    assert result.vertices.dtype == mask.vertices.dtype


def test_a_part_of_a_face_leaves_the_rest_to_its_neighbours(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, truth: Tensor, registered: Registration
) -> None:
    """Half of the forehead is missing; nothing collapses onto the border of the hole."""
    inverse = registered.pose.inverse()
    local = inverse.apply(scan.vertices)[0]
    hole = (local[:, 1] > 60) & (local[:, 0] > 0)
    holed = Mesh(scan.vertices, scan.faces[~hole[scan.faces].any(1)])
    result = register(mask, holed, landmarks)
    missing = (mask.vertices[:, 1] > 66) & (mask.vertices[:, 0] > 6)
    assert not result.matched[missing].any()
    assert float(error(result, truth)[missing].mean()) < 3.0
    assert float(error(result, truth)[~missing].mean()) < 1.5 * float(error(registered, truth).mean()) + 0.1
    assert result.record.stages[-1].dropped["border"] > registered.record.stages[-1].dropped["border"]


def test_lumps_of_hair_leave_the_face_alone(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, truth: Tensor, registered: Registration
) -> None:
    local = registered.pose.inverse().apply(scan.vertices)[0]
    generator = torch.Generator().manual_seed(0)
    lump = 25 * ((local[:, 1] - 70) / 30).clamp(0, 1) + 4 * torch.randn(len(local), generator=generator).double() * (
        local[:, 1] > 70
    )
    hairy = Mesh(registered.pose.apply(local + lump[:, None] * torch.tensor([0.0, 0.3, 0.95]))[0], scan.faces)
    result = register(mask, hairy, landmarks)
    face = mask.vertices[:, 1] < 50
    assert float(error(result, truth)[face].mean()) < float(error(registered, truth)[face].mean()) + 0.3
    assert turned_over(result, mask) == 0


def test_crumbs_are_dropped_and_told(mask: Mesh, scan: Mesh, landmarks: Landmarks, registered: Registration) -> None:
    crumb = scan.vertices[:30] * 0.02 + scan.vertices.mean(0) * 0.98
    faces = torch.arange(30).reshape(10, 3) + len(scan.vertices)
    result = register(mask, Mesh(torch.cat([scan.vertices, crumb]), torch.cat([scan.faces, faces])), landmarks)
    assert any("loose parts" in note for note in result.record.notes)
    assert torch.allclose(result.mesh.vertices, registered.mesh.vertices, atol=1e-6)


@pytest.mark.parametrize("given", ["registered", pytest.param("by_shape", marks=pytest.mark.bench)])
def test_flipped_normals_are_turned_and_told(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, request: pytest.FixtureRequest, given: str
) -> None:
    inside_out = Mesh(scan.vertices, scan.faces.flip(1))
    result = register(mask, inside_out, landmarks if given == "registered" else None)
    assert any("flipped normals" in note for note in result.record.notes)
    expected = request.getfixturevalue(given)
    assert float((result.mesh.vertices - expected.mesh.vertices).norm(dim=1).max()) < 0.1


def test_landmarks_off_the_surface_or_missing_are_left_out_and_told(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, truth: Tensor, registered: Registration
) -> None:
    points = landmarks[1].clone()
    points[0] = torch.nan
    points[1] += 60.0
    result = register(mask, scan, (landmarks[0], points))
    told = [note for note in result.record.notes if "landmarks" in note]
    assert len(told) == 1
    assert "1 are NaN" in told[0]
    assert "1 lie more than 15 mm off" in told[0]
    assert float(error(result, truth).mean()) < float(error(registered, truth).mean()) + 0.4


def test_a_detector_is_asked_where_no_landmarks_are_given(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, truth: Tensor, registered: Registration
) -> None:
    seen: list[Tensor] = []

    def detector(laid: Mesh, surface: Mesh, pose) -> Landmarks | None:
        seen.append((laid.vertices - truth).norm(dim=1).mean())
        assert surface is scan
        return landmarks

    found = register(mask, scan, detector=detector)
    assert found.record.start == "detected landmarks"
    assert float(seen[0]) < 8.0
    assert torch.allclose(found.mesh.vertices, registered.mesh.vertices, atol=1e-6)


def test_parts_that_share_no_vertex_follow(
    mask: Mesh, scan: Mesh, landmarks: Landmarks, registered: Registration
) -> None:
    """A bead behind the surface keeps its distance to the face and its form."""
    bead = torch.tensor([[-4.0, 0, 0], [4, 0, 0], [0, 5, 0], [0, 0, 5]]).double() + torch.tensor([33.0, 25, 40])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]) + len(mask.vertices)
    both = Mesh(torch.cat([mask.vertices, bead]), torch.cat([mask.faces, faces]))
    result = register(both, scan, landmarks)
    assert float((result.mesh.vertices[:-4] - registered.mesh.vertices).norm(dim=1).mean()) < 0.2
    end = result.mesh.vertices[-4:]
    scale = torch.pdist(end) / torch.pdist(bead)
    assert 0.8 < float(scale.min()) <= float(scale.max()) < 1.25
    laid = result.pose.apply(bead)[0]
    assert float((end - laid).norm(dim=1).max()) < 8.0


@dataclass(eq=False)
class RealScan:
    """A scanned person with annotated landmarks, registered with them and without."""

    template: Mesh
    scan: Mesh
    points: Tensor

    @cached_property
    def given(self) -> Registration:
        return register(self.template, self.scan, (self.template.landmarks, self.points), texture_size=256)

    @cached_property
    def by_shape(self) -> Registration:
        return register(self.template, self.scan, texture_size=256)


@pytest.fixture(scope="module")
def real(data: Path, ict_folder: Path) -> RealScan:
    template = load_identity_modes(ict_folder, count=1, part="face").neutral
    scan = load_mesh(data / "scans" / "james" / "james.obj")
    return RealScan(template, scan, load_landmark_points(data / "scans" / "james" / "james.ljson").ibug())


@pytest.mark.real
def test_a_second_head_is_named_where_only_the_whole_template_fits(ict_folder: Path) -> None:
    short, head = Schedule(DEFAULT_SCHEDULE.stages[:1]), load_rig(ict_folder).neutral
    made = register(neutral_head(texture=False), beside_itself(head), schedule=short, texture_size=0)
    assert any("more than one place" in note for note in made.record.notes)


@pytest.mark.real
def test_a_real_registration_lies_at_its_landmarks(real: RealScan) -> None:
    residual = (real.given.mesh.vertices[real.template.landmarks[17:]].double() - real.points[17:]).norm(dim=1)
    assert float(residual.mean()) < 1.2
    assert any("along the jaw" in note for note in real.given.record.notes)


@pytest.mark.real
@pytest.mark.parametrize(
    "size", [0.07, pytest.param(0.1, marks=pytest.mark.bench)]
)  # millimetres of its unit: a small child's head, and a very large one
def test_a_head_of_another_size_and_shape_is_found_without_landmarks(data: Path, size: float) -> None:
    """Whose face fits best is taken: with one size of the template alone, both were found upside down."""
    head = load_rig(data / "characters" / "facecap.glb").neutral
    scan = Mesh(head.vertices * size, head.faces)
    found = register(neutral_head(texture=False), scan, schedule=Schedule(DEFAULT_SCHEDULE.stages[:1]), texture_size=0)
    assert float(found.pose.rotation[0].diagonal().sum()) > 1 + 2 * math.cos(math.radians(10))


def test_a_face_that_fits_nowhere_well_is_said_with_its_fit(mask: Mesh) -> None:
    drawn = torch.randn(mask.vertices.shape, generator=torch.Generator().manual_seed(0)) * 3.0
    rough = Mesh((mask.vertices + drawn).float(), mask.faces)
    found = register(mask, rough, schedule=Schedule(DEFAULT_SCHEDULE.stages[:1]))
    assert any("fits 0." in note and "give landmarks" in note for note in found.record.notes)


def test_half_a_head_that_fits_at_no_heads_size_is_refused_without_landmarks() -> None:
    """Of a half the template covered all, 1.4 times as large, and only remarks said so."""
    somebody = neutral_head(draw_identities(4, torch.Generator().manual_seed(11))[3], texture=False)
    regions = somebody.annotations.regions
    inner = torch.stack([regions[name] for name in regions if name.startswith(("mouth_interior", "teeth", "eyeball"))])
    shown = (somebody.vertices[:, 0] > -5) & ~inner.any(0)
    half = Mesh(somebody.vertices, somebody.faces[shown[somebody.faces].all(1)])
    with pytest.raises(AlignmentError, match=r"times its size, where it fits 0\.\d\d of 1; .* Give landmarks"):
        register(neutral_head(texture=False), half, schedule=Schedule(DEFAULT_SCHEDULE.stages[:1]), texture_size=0)


@pytest.mark.real
@pytest.mark.parametrize("given", [True, pytest.param(False, marks=pytest.mark.bench)])
def test_a_real_scan_is_met_inside_the_face(real: RealScan, given: bool) -> None:
    """Hair, ears under hair, collar and holes are left; lips, lids and nose lie where they were annotated."""
    template, scan, points = real.template, real.scan, real.points
    result = real.given if given else real.by_shape
    assert given or real.given.record.matched >= result.record.matched - 0.005
    face = template.annotations.regions["narrow_face"]
    assert float(result.distance[face].median()) < 0.15
    inner = (result.mesh.vertices[template.landmarks].double() - points).norm(dim=1)[17:]
    assert float(inner.median()) < (2.0 if given else 3.5)
    assert turned_over(result, template) == 0
    on_scan = SurfaceIndex(scan.vertices, scan.faces).nearest(result.mesh.vertices[result.matched].double())
    beyond = result.distance[result.matched] - on_scan.distance  # a loose part that was left out may be nearer
    assert float(beyond.min()) > -1e-4
    assert float((beyond < 1e-4).double().mean()) > 0.99
    assert 0.6 < result.record.matched < 0.95


def test_float32_templates_come_back_as_float32(mask: Mesh, scan: Mesh, landmarks: Landmarks) -> None:
    single = replace(mask, vertices=mask.vertices.float())
    assert register(single, scan, landmarks).mesh.vertices.dtype == torch.float32
