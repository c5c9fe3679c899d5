"""Points of the mean head lie in the same places on heads of other topologies."""

import torch

from torchface import zoo
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.identity import sculpted_vertices
from torchface.synthetic.head.performer import performer
from torchface.workflows.surface_sites import sites_on_rig


def renumbered(scale: float) -> BlendshapeRig:
    """The mean performer with its vertices in another order and of another size."""
    rig = performer(texture=False)
    order = torch.randperm(len(rig.vertices), generator=torch.Generator().manual_seed(0))
    place = order.argsort()
    mesh = rig.neutral
    notes = mesh.annotations
    moved = type(mesh)(
        scale * sculpted_vertices().float()[order], place[mesh.faces], annotations=type(notes)(place[notes.landmarks])
    )
    return BlendshapeRig(moved, scale * rig.deltas[:, order], rig.names)


def test_points_lie_in_the_same_places_on_another_topology() -> None:
    places = zoo.get_model("landmark_network").places
    for scale in (1.0, 0.5):
        rig = renumbered(scale)
        there = sites_on_rig(rig, places).on(rig.neutral.faces, rig.vertices)
        off = (there / scale - places).norm(dim=1)
        assert float(off.median()) < 0.05, scale
        assert float(off.max()) < 2.0, scale
