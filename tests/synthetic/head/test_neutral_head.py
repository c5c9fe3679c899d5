"""The embedded head: its topology, its measurements, and how they answer to the identity."""

import pytest
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import border_vertices, components, triangle_areas, triangle_normals
from torchface.mesh import Mesh
from torchface.synthetic import IDENTITY, draw_identities, neutral_head
from torchface.synthetic.head.facial_openings import lid_order
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.topology import EAR_RIM, EYE_RIM, topology

# Adult human means, millimetres.
HUMAN = {
    "face_height": 120, "face_width": 137, "jaw_width": 105, "pupil_distance": 63, "eye_width": 30, "nose_length": 50,
    "nose_width": 35, "nose_protrusion": 19, "mouth_width": 51, "philtrum": 15, "head_length": 190, "head_width": 152,
}  # fmt: skip
MEASURED = [p.name for p in IDENTITY if p.mean]


WING_ROW, WING_COLUMN = 19, 5
JAW_ANGLE_ROW, JAW_ANGLE_COLUMN = 31, 19


def measure(head: Mesh) -> dict[str, float]:
    """Lengths in millimetres by name of a performer's head, those of ``IDENTITY`` whose mean is a measurement.

    Args:
        head: a mesh of the embedded performer's topology.
    """
    t, v = topology(), head.vertices.double()
    marks = v[head.landmarks]
    skin = v[head_annotations().regions["face"] | head_annotations().regions["cranium"]]
    rim = v[t.rings["eye"][EYE_RIM]]
    inner, outer = rim[lid_order()[0][[0, 16]]]
    balls = [v[head_annotations().regions[f"eyeball_{side}"]] for side in ("left", "right")]
    low = skin[(skin[:, 1] > -45) & (skin[:, 1] < 5) & (skin[:, 2] > 5)]
    ear = v[t.rings["ear"][EAR_RIM]]
    span = lambda points, axis: float(points[:, axis].max() - points[:, axis].min())  # noqa: E731
    return {
        "head_length": span(skin[skin[:, 1] > 8], 2),
        "head_width": span(skin[skin[:, 1] > 8], 0),
        "head_height": float(skin[:, 1].max() - _middle(balls[0])[1]),
        "face_width": span(low, 0),
        "jaw_width": 2 * float(v[t.grid[JAW_ANGLE_ROW, JAW_ANGLE_COLUMN], 0]),
        "face_height": float(marks[27, 1] - marks[8, 1]),
        "nose_length": float(marks[27, 1] - marks[33, 1]),
        "nose_width": 2 * float(v[t.grid[WING_ROW, WING_COLUMN], 0]),
        "nose_protrusion": float(marks[30, 2] - marks[33, 2]),
        "philtrum": float(marks[33, 1] - marks[51, 1]),
        "pupil_distance": float(_middle(balls[0])[0] - _middle(balls[1])[0]),
        "eye_width": float((outer - inner).norm()),
        "eye_size": span(balls[0], 0) / 2,
        "mouth_width": float(marks[54, 0] - marks[48, 0]),
        "ear_size": span(ear, 1),
    }


def _middle(points: Tensor) -> Tensor:
    return (points.amax(0) + points.amin(0)) / 2


def identity(**coefficients: float) -> torch.Tensor:
    names = [p.name for p in IDENTITY]
    vector = torch.zeros(len(IDENTITY))
    for name, value in coefficients.items():
        vector[names.index(name)] = value
    return vector


@pytest.fixture(scope="module")
def mean():
    return neutral_head()


def test_mean_head_measures_as_people_do(mean):
    found = measure(mean)
    for name, expected in HUMAN.items():
        assert found[name] == pytest.approx(expected, rel=0.05), name


def test_the_profile_is_as_convex_as_peoples_and_the_lips_lie_behind_nose_and_chin(mean):
    """Angle of glabella, subnasale and pogonion 12 degrees with a deviation of 4 (Legan and Burstone 1980); lips behind
    the line from nose to chin, the lower one by 2 mm with a deviation of 2 (Ricketts 1968)."""
    skin = mean.vertices[(mean.vertices[:, 0].abs() < 1) & (mean.vertices[:, 2] > 40)]

    def foremost(low: float, high: float) -> Tensor:
        rows = skin[(skin[:, 1] > low) & (skin[:, 1] < high)]
        return rows[rows[:, 2].argmax(), 1:]

    glabella, nose, upper, lower, chin = (
        foremost(*heights) for heights in ((5, 25), (-45, -25), (-66, -57), (-80, -68), (-115, -92))
    )
    subnasale = mean.vertices[mean.landmarks[33], 1:]
    up, down = glabella - subnasale, chin - subnasale
    convexity = 180 - float(torch.rad2deg(torch.acos((up @ down) / (up.norm() * down.norm()))))
    assert 8 < convexity < 16
    along = torch.nn.functional.normalize(nose - chin, dim=0)
    forward = torch.stack([-along[1], along[0]])
    assert -4 < float((lower - chin) @ forward) < 0
    assert -6 < float((upper - chin) @ forward) < 0


@pytest.mark.parametrize("name", MEASURED)
def test_two_deviations_change_the_measurement_by_what_they_say(mean, name):
    parameter = next(p for p in IDENTITY if p.name == name)
    changed = measure(neutral_head(identity(**{name: 2.0}), texture=False))[name] - measure(mean)[name]
    assert changed == pytest.approx(2 * parameter.standard_deviation, rel=0.12)


def test_every_parameter_moves_the_face_by_human_amounts(mean):
    for parameter in IDENTITY:
        moved = neutral_head(identity(**{parameter.name: 1.0}), texture=False).vertices - mean.vertices
        largest = float(moved.norm(dim=1).max())
        assert 0.3 <= largest <= 9.0, parameter.name
    assert len(IDENTITY) >= 20


def test_quads_of_four_to_eight_thousand_vertices_with_one_border_at_the_neck(mean):
    assert 4000 <= len(mean.vertices) <= 8000
    assert mean.polygons.shape[1] == 4
    assert (mean.polygons >= 0).all()
    border = border_vertices(mean.faces, len(mean.vertices))
    regions = mean.annotations.regions
    assert regions["neck"][border].all()
    assert mean.vertices[border, 1].max() < -150
    # One skin with its mouth and sockets, two eyeballs.
    part = components(mean.faces, len(mean.vertices))
    assert int(part.max()) == 2
    assert len(part[regions["eyeball_left"]].unique()) == 1


def test_each_edge_has_at_most_two_faces_that_run_opposite_ways(mean):
    f = mean.faces
    directed = torch.cat([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    assert len(directed.unique(dim=0)) == len(directed)


def test_topology_and_position_mirror_exactly():
    generator = torch.Generator().manual_seed(4)
    mesh = neutral_head(draw_identities(1, generator)[0], texture=False)
    mirror = mesh.annotations.mirror
    assert torch.equal(mirror[mirror], torch.arange(len(mirror)))
    reflected = mesh.vertices[mirror] * torch.tensor([-1.0, 1.0, 1.0])
    assert (reflected - mesh.vertices).abs().max() < 1e-4
    quads = {tuple(sorted(q)) for q in mesh.polygons.tolist()}
    assert quads == {tuple(sorted(q)) for q in mirror[mesh.polygons].tolist()}


def test_landmarks_follow_ibug_order(mean):
    p = mean.vertices[mean.landmarks]
    assert len(set(mean.landmarks.tolist())) == 68
    assert (p[:17, 0].diff() > 0).all()  # the jaw from the viewer's left to the right
    assert p[8, 1] == p[:17, 1].min()
    assert (p[17:27, 0].diff() > 0).all()
    assert (p[27:31, 1].diff() < 0).all()
    assert p[30, 2] == p[:, 2].max()
    assert (p[31:36, 0].diff() > 0).all()
    assert p[36, 0] < p[39, 0] < 0 < p[42, 0] < p[45, 0]
    assert (p[[37, 38], 1] > p[[41, 40], 1]).all()
    assert (p[[43, 44], 1] > p[[47, 46], 1]).all()
    assert (p[48:55, 0].diff() > 0).all()
    assert (p[54:60, 0].diff() < 0).all()
    assert p[51, 1] > p[62, 1] > p[66, 1] > p[57, 1]
    # Landmarks mirror each other as 68 points do.
    pairs = [(i, 16 - i) for i in range(8)] + [(17 + i, 26 - i) for i in range(5)] + [(31, 35), (32, 34)]
    pairs += [(36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46), (48, 54), (49, 53), (50, 52), (59, 55)]
    pairs += [(58, 56), (60, 64), (61, 63), (67, 65)]
    for a, b in pairs:
        assert mean.annotations.mirror[mean.landmarks[a]] == mean.landmarks[b]


def test_regions_lie_where_they_are_named(mean):
    regions, y = mean.annotations.regions, mean.vertices[:, 1]
    order = ["forehead", "brow_left", "nose", "upper_lip", "lower_lip", "chin", "neck"]
    heights = [float(y[regions[name]].mean()) for name in order]
    assert heights == sorted(heights, reverse=True)
    for name in ("brow", "lids", "eye", "eyeball", "cheek", "ear"):
        left, right = regions[f"{name}_left"], regions[f"{name}_right"]
        assert (mean.vertices[left, 0] > 0).all(), name
        assert torch.equal(left[mean.annotations.mirror], right), name
    assert not (regions["face"] & (regions["neck"] | regions["cranium"])).any()


def test_lips_touch_lightly_and_lids_stand_open_on_every_head():
    for coefficients in draw_identities(6, torch.Generator().manual_seed(1)):
        mesh = neutral_head(coefficients, texture=False)
        v, pairs, regions = mesh.vertices, mesh.annotations.contacts, mesh.annotations.regions
        apart = (v[pairs[:, 0]] - v[pairs[:, 1]]).norm(dim=1)
        on_lips = regions["upper_lip"][pairs[:, 0]]
        assert on_lips.sum() >= 20
        assert (~on_lips).sum() >= 50
        assert apart[on_lips].max() <= 0.5
        assert (v[pairs[on_lips, 0], 1] >= v[pairs[on_lips, 1], 1]).all()
        assert apart[~on_lips].max() > 6


def test_texture_coordinates_have_seams_and_do_not_overlap(mean):
    # Signed area of every triangle on the page: none is turned over.
    corners = mean.uvs[mean.uv_faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    assert (area > 0).all()
    assert mean.uvs.min() >= 0
    assert mean.uvs.max() <= 1
    pairs = torch.stack([mean.faces.flatten(), mean.uv_faces.flatten()], dim=1).unique(dim=0)
    assert len(pairs) > len(mean.vertices)


def test_texture_paints_lips_redder_and_brows_darker_than_the_cheek(mean):
    from torchface.rendering.clay_shading import sample_texture

    regions = mean.annotations.regions
    color = {}
    for name in ("cheek_left", "upper_lip", "brow_left", "mouth_interior"):
        inside = regions[name][mean.faces].all(1)
        if name == "brow_left":  # the region is skin round the brow as well; its hair is what lies near its arch
            centre = mean.vertices[mean.faces].mean(1)
            inside &= ((centre[:, 1] - 23.5).abs() < 2.5) & (centre[:, 0] > 15) & (centre[:, 0] < 42)
        color[name] = sample_texture(mean.texture, mean.uvs[mean.uv_faces[inside]].mean(1)).mean(0)
    redness = {name: float(c[0] / c[1]) for name, c in color.items()}
    assert redness["upper_lip"] > 1.15 * redness["cheek_left"]
    assert color["brow_left"].mean() < 0.75 * color["cheek_left"].mean()
    assert color["mouth_interior"].mean() < 0.4 * color["cheek_left"].mean()


def test_identity_moves_the_head_smoothly():
    drawn = draw_identities(1, torch.Generator().manual_seed(9))[0].double()
    step = 1e-2 * torch.randn(len(IDENTITY), generator=torch.Generator().manual_seed(2)).double()
    at = [neutral_head(drawn + k * step, texture=False).vertices.double() for k in (-1, 0, 1)]
    first, second = (at[2] - at[0]).norm() / 2, (at[2] - 2 * at[1] + at[0]).norm()
    assert second < 0.02 * first


def test_random_heads_do_not_fold(mean):
    normals = triangle_normals(mean.vertices, mean.faces)
    regions = mean.annotations.regions
    shown = ~(regions["mouth_interior"] | regions["eye_sockets"] | regions["nostrils"])[mean.faces].any(1)
    shown &= triangle_areas(mean.vertices, mean.faces) > 0.1  # corners of lids and lips come to points
    for coefficients in draw_identities(8, torch.Generator().manual_seed(3)):
        other = neutral_head(coefficients, texture=False).vertices
        assert ((triangle_normals(other, mean.faces) * normals).sum(1)[shown] > 0).all()
        assert (triangle_areas(other, mean.faces) > 0.15 * triangle_areas(mean.vertices, mean.faces))[shown].all()


def test_drawn_identities_are_clipped_repeatable_and_spread():
    drawn = draw_identities(4000, torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, len(IDENTITY))
    assert drawn.abs().max() == 2.5
    assert float(drawn.std()) == pytest.approx(0.99, abs=0.02)
    assert torch.equal(drawn, draw_identities(4000, torch.Generator().manual_seed(0)))
    near = draw_identities(4000, torch.Generator().manual_seed(0), scale=0.5)
    assert float(near.std()) == pytest.approx(0.5, abs=0.01)


def test_what_differs_between_the_sexes_goes_together():
    together = torch.corrcoef(draw_identities(4000, torch.Generator().manual_seed(0)).T)
    names = [p.name for p in IDENTITY]
    width, ridge, brows, crown = (names.index(n) for n in ("face_width", "brow_ridge", "brow_height", "head_height"))
    # Sexes whose means are d deviations apart add d/2 with the sign of the sex to what else has deviation 1.
    share = {i: d / 2 / (1 + d**2 / 4) ** 0.5 for i, d in ((width, 1.4), (ridge, 1.6), (brows, -1.2))}
    assert float(together[width, ridge]) == pytest.approx(share[width] * share[ridge], abs=0.05)
    assert float(together[ridge, brows]) == pytest.approx(share[ridge] * share[brows], abs=0.05)
    assert abs(float(together[crown, width])) < 0.05


def test_wrong_identities_are_refused():
    with pytest.raises(ShapeError, match=r"identity: found \(3,\), expected"):
        neutral_head(torch.zeros(3))
    with pytest.raises(ValueRangeError, match="NaN"):
        neutral_head(torch.full((len(IDENTITY),), float("nan")))


def test_rings_run_round_eye_and_mouth():
    rings = topology().rings
    mesh = neutral_head(texture=False)
    for name in ("eye", "mouth"):
        ring = mesh.vertices[rings[name]]
        size = (ring.amax(1) - ring.amin(1))[:, :2].norm(dim=1)
        assert (size[:8].diff() < 0).all(), name  # each loop lies inside the one before
