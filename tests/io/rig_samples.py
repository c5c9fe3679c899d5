"""Small rigs for the tests of readers and writers: polygons of several sizes, seams, annotations, a texture."""

import torch
from hypothesis import strategies as st

from torchface import Annotations, BlendshapeRig, Corrective, Correctives, Mesh, Take, Track


def quad_sheet(columns: int = 6, rows: int = 5) -> Mesh:
    """A bent sheet of quads and two triangles, its texture coordinates torn apart along the middle row."""
    across, down = torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy")
    x, y = across.flatten().float() * 10 - 25, down.flatten().float() * 10 - 20
    vertices = torch.stack([x, y, 30 - 0.02 * x**2 - 0.01 * y**2], dim=1)
    corner = (down[:-1, :-1] * columns + across[:-1, :-1]).flatten()
    polygons = torch.stack([corner, corner + 1, corner + 1 + columns, corner + columns], dim=1)
    half = polygons[-1]
    triangles = torch.tensor([[half[0], half[1], half[2], -1], [half[0], half[2], half[3], -1]])
    polygons = torch.cat([polygons[:-1], triangles])
    grid = torch.stack([across.flatten() / (columns - 1), down.flatten() / (rows - 1)], dim=1).float()
    upper = polygons[:, :1] >= (rows // 2) * columns
    uvs = torch.cat([grid * 0.4, grid * 0.4 + 0.5])
    uv_polygons = torch.where(polygons >= 0, polygons + upper * len(grid), -1)
    used, uv_polygons = uv_polygons.unique(return_inverse=True)  # the first is the padding
    count = columns * rows
    return Mesh.from_polygons(
        vertices,
        polygons,
        uvs[used[1:]],
        uv_polygons - 1,
        colors=torch.linspace(0, 1, count * 3).reshape(count, 3),
        texture=torch.arange(3 * 4 * 8).reshape(3, 4, 8).remainder(17) / 17,
        annotations=Annotations(
            landmarks=torch.tensor([3, 17, 0]),
            regions={"lower": torch.arange(count) < 12, "corner": torch.arange(count) == count - 1},
            mirror=(down * columns + (columns - 1 - across)).flatten(),
            contacts=torch.tensor([[0, 5], [6, 11]]),
        ),
    )


def sheet_rig() -> BlendshapeRig:
    """The sheet with a shape that moves one corner, one that moves all, and one that moves nothing."""
    mesh = quad_sheet()
    generator = torch.Generator().manual_seed(1)
    deltas = torch.randn(3, len(mesh.vertices), 3, generator=generator)
    deltas[0, 3:] = 0
    deltas[2] = 0
    return BlendshapeRig(mesh, deltas, ("jawOpen", "mouthSmileLeft", "eyeBlinkRight"))


def named_sheet(names: tuple[str, ...]) -> BlendshapeRig:
    """The sheet with a shape of each name, which moves all of it."""
    mesh = quad_sheet()
    deltas = torch.randn(len(names), len(mesh.vertices), 3, generator=torch.Generator().manual_seed(0))
    return BlendshapeRig(mesh, deltas, names)


def corrective_sheet() -> BlendshapeRig:
    """The sheet's rig with a product of two, one of three, and an in-between."""
    rig = sheet_rig()
    definitions = (
        Corrective("jaw_smile", ("jawOpen", "mouthSmileLeft")),
        Corrective("all", ("eyeBlinkRight", "jawOpen", "mouthSmileLeft")),
        Corrective("jaw_third", ("jawOpen",), 1 / 3),
    )
    deltas = torch.randn(3, len(rig.vertices), 3, generator=torch.Generator().manual_seed(3))
    return BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(deltas, definitions))


def sheet_take(frames: int = 5) -> Take:
    """Weights for two of the sheet's shapes and for one it lacks."""
    values = torch.linspace(0, 1, frames * 3).reshape(frames, 3, 1)
    return Take(60.0, weights=Track(("MouthSmileLeft", "tongueOut", "JawOpen"), values))


@st.composite
def rigs(draw: st.DrawFn) -> BlendshapeRig:
    """Rigs of random polygons and seams, vertices that lie on each other, loose ones, and odd names."""
    seed = draw(st.integers(0, 2**31))
    generator = torch.Generator().manual_seed(seed)
    count = draw(st.integers(6, 25))
    vertices = torch.randn(count, 3, generator=generator) * 100
    vertices[count // 2] = vertices[0]  # as where lips touch
    sizes = draw(st.lists(st.integers(3, 6), min_size=1, max_size=12))
    widest = max(sizes)
    polygons = torch.full((len(sizes), widest), -1)
    uv_polygons = torch.full((len(sizes), widest), -1)
    uv_count = draw(st.integers(1, 40))
    for row, size in enumerate(sizes):
        polygons[row, :size] = torch.randperm(count, generator=generator)[:size]
        uv_polygons[row, :size] = torch.randint(uv_count, (size,), generator=generator)
    seams = draw(st.booleans())
    uvs = torch.rand(uv_count, 2, generator=generator) if seams else None
    names = draw(st.lists(st.text(max_size=12), min_size=1, max_size=5, unique=True))
    moving = torch.rand(len(names), count, 1, generator=generator) < draw(st.sampled_from([0.1, 0.5, 1.0]))
    deltas = torch.randn(len(names), count, 3, generator=generator) * moving
    notes = Annotations(
        landmarks=torch.randint(count, (draw(st.integers(0, 9)),), generator=generator),
        regions={name: torch.rand(count, generator=generator) < 0.5 for name in draw(st.sets(st.text(max_size=5)))},
        mirror=torch.randperm(count, generator=generator) if draw(st.booleans()) else None,
        contacts=torch.randint(count, (draw(st.integers(0, 4)), 2), generator=generator),
    )
    mesh = Mesh.from_polygons(
        vertices,
        polygons,
        uvs,
        uv_polygons if seams else None,
        colors=torch.rand(count, 3, generator=generator) if draw(st.booleans()) else None,
        annotations=notes if draw(st.booleans()) else None,
    )
    return BlendshapeRig(mesh, deltas, names)
