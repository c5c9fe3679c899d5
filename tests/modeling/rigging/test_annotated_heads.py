"""A head takes landmarks and regions over from a template that lies on it."""

import torch

from planted.characters import other_topology
from torchface import Annotations, BlendshapeRig, Mesh
from torchface.geometry.meshes.operators import components
from torchface.geometry.similarity import Similarity
from torchface.modeling.rigging.annotated_heads import annotations_on
from torchface.synthetic import performer

SAME = Similarity(torch.ones(1).double(), torch.eye(3).double()[None], torch.zeros(1, 3).double())


def test_a_head_of_another_topology_gets_the_landmarks() -> None:
    person = performer(texture=False)
    notes = annotations_on(other_topology(person), person, SAME)
    head, own = other_topology(person), person.neutral.annotations
    assert torch.equal(head.vertices[notes.landmarks], person.vertices[own.landmarks])
    place = torch.cdist(person.vertices, head.vertices).argmin(1)
    assert notes.regions.keys() == own.regions.keys()
    for name, mask in own.regions.items():
        assert float((notes.regions[name][place] == mask).double().mean()) > 0.999


def test_of_lips_that_touch_the_one_that_moves_alike_is_taken() -> None:
    """Two strips in one place; the second goes down with the jaw. A tooth before them is another part."""
    strip = torch.tensor(
        [[0.0, 0, 0], [10, 0, 0], [0, 5, 0], [10, 5, 0], [0, 0, 0], [10, 0, 0], [0, -5, 0], [10, -5, 0]]
    )
    skin = torch.tensor([[0, 1, 2], [1, 3, 2], [4, 6, 5], [5, 6, 7], [2, 3, 8], [3, 9, 8], [6, 8, 7], [7, 8, 9]])
    ends = torch.tensor([[-20.0, 0, 0], [30, 0, 0]])
    tooth = torch.tensor([[5.0, 0, 0.1], [5, 1, 0.1], [6, 1, 0.1]])
    jaw = torch.zeros(13, 3)
    jaw[4:8, 1] = -30.0
    points = torch.cat([strip, ends, tooth])
    head = BlendshapeRig(Mesh(points, torch.cat([skin, torch.tensor([[10, 11, 12]])])), jaw[None], ("jawOpen",))
    marks = torch.tensor([0, 4, 1, 5] * 17)
    template = BlendshapeRig(Mesh(points[:10], skin, annotations=Annotations(marks)), jaw[None, :10], ("jawOpen",))
    shifted = BlendshapeRig(template.neutral.with_vertices(points[:10] + 0.2), template.deltas, template.names)
    assert torch.equal(annotations_on(head, shifted, SAME).landmarks, marks)


def test_an_eye_of_its_own_is_an_eyeball_from_front_to_back() -> None:
    """Also where the template's has another size and place."""
    person = performer(texture=False)
    head, own = other_topology(person), person.neutral.annotations
    ball = own.regions["eyeball_left"]
    middle = person.vertices[ball].mean(0)
    smaller = torch.where(ball[:, None], middle + 0.9 * (person.vertices - middle), person.vertices)
    template = BlendshapeRig(person.neutral.with_vertices(smaller), person.deltas, person.names)
    found = annotations_on(head, template, SAME).regions["eyeball_left"]
    place = torch.cdist(person.vertices, head.vertices).argmin(1)
    label = components(head.neutral.faces, len(head.vertices))
    eye = label == label[place[ball]].mode().values
    assert bool(found[eye].all())


def test_loose_parts_in_the_mouth_as_narrow_as_teeth_are_teeth() -> None:
    """Also those that stand beside the template's mouth, next to another; a stud in the ear is none."""
    person = performer(texture=False)
    inside = person.neutral.annotations.regions["mouth_interior"]
    front = person.vertices[inside][person.vertices[inside][:, 2].argmax()] - torch.tensor([0.0, 0, 2])
    corners = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4]])
    places = [front, front + torch.tensor([5.0, 0, 0]), front + torch.tensor([10.0, 0, 0]), person.vertices[:, 0].max()]
    parts = torch.cat([corners + place for place in places])
    count, sides = len(person.vertices), torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    faces = torch.cat([person.neutral.faces, *(count + 4 * k + sides for k in range(4))])
    deltas = torch.cat([person.deltas, person.deltas.new_zeros(len(person.names), 16, 3)], 1)
    head = BlendshapeRig(Mesh(torch.cat([person.vertices, parts]), faces), deltas, person.names)
    regions = annotations_on(head, person, SAME).regions
    assert regions["teeth"].nonzero()[:, 0].tolist() == list(range(count, count + 12))
    assert not bool((regions["mouth_interior"] & regions["teeth"]).any())
