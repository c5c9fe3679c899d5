"""Each triangle shows in the one image what it showed in its own."""

from pathlib import Path

import numpy as np
import torch

from tests.io.gltf.gltf_samples import SQUARE, SQUARE_TRIANGLES, Builder
from torchface.color_space import to_srgb
from torchface.io.gltf.gltf_reading import read_gltf_mesh
from torchface.io.images.image_files import encode_png
from torchface.io.images.texture_atlas import Look, with_looks
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture


def picture(seed: int, height: int, width: int) -> torch.Tensor:
    levels = torch.randint(0, 256, (3, height, width), generator=torch.Generator().manual_seed(seed))
    return levels / 255


def shown(mesh: Mesh, triangle: int, at: torch.Tensor) -> torch.Tensor:
    return sample_texture(mesh.texture, at @ mesh.uvs[mesh.uv_faces[triangle]])


def test_images_of_other_sizes_and_tiles_and_a_plain_colour_are_shown_as_they_were() -> None:
    generator = torch.Generator().manual_seed(3)
    uvs = torch.tensor([[0.05, 0.1], [0.9, 0.0], [0.4, 1.0]])
    faces = torch.tensor([[0, 1, 2]] * 4)
    tiles = torch.tensor([[0.0, 0.0], [2.0, -1.0], [0.0, 0.0], [0.0, 0.0]])
    moved = (uvs + tiles[:, None]).reshape(-1, 2)
    mesh = Mesh(torch.eye(3), faces, moved, torch.arange(12).reshape(4, 3))
    looks = [
        Look(picture(1, 20, 33)),
        Look(picture(2, 64, 7), torch.tensor([0.5, 1.0, 0.25])),
        Look(None, torch.tensor([0.2, 0.4, 0.6])),
    ]
    look = torch.tensor([0, 1, 2, 1])
    both = with_looks(mesh, look, looks)
    at = torch.rand(50, 3, generator=generator)
    at = at / at.sum(1, keepdim=True)
    for triangle, number in enumerate(look.tolist()):
        one = looks[number]
        own = torch.ones(50, 3) if one.image is None else sample_texture(one.image, at @ uvs)
        assert torch.allclose(shown(both, triangle, at), own * one.color, atol=1e-4)
    assert torch.equal(with_looks(mesh, torch.zeros(4).long(), looks[:1]).uvs, moved)


def test_a_strip_longer_than_an_image_may_be_is_made_shorter() -> None:
    """Four texels high: a strip that has hardly anything to give up."""
    strip = torch.linspace(0, 1, 9000).expand(3, 4, -1)
    corners = torch.tensor([[0.0, 0.5], [1.0, 0.5], [0.5, 0.5]])
    mesh = Mesh(torch.eye(3), torch.tensor([[0, 1, 2], [0, 2, 1]]), uvs=corners, uv_faces=torch.tensor([[0, 1, 2]] * 2))
    made = with_looks(mesh, torch.tensor([0, 1]), [Look(strip), Look(None, torch.tensor([1.0, 0.0, 0.0]))])
    assert max(made.texture.shape[1:]) <= 8192
    for share in (0.1, 0.5, 0.9):
        found = shown(made, 0, torch.tensor([[1 - share, share, 0.0]]))[0]
        torch.testing.assert_close(found, torch.full((3,), share), atol=2e-3, rtol=0)
    torch.testing.assert_close(shown(made, 1, torch.full((1, 3), 1 / 3))[0], torch.tensor([1.0, 0.0, 0.0]))


def test_a_file_of_two_images_and_a_plain_colour_keeps_all_three(tmp_path: Path) -> None:
    build = Builder()
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    primitives = []
    for number in range(3):  # one beside the other
        attributes = {
            "POSITION": build.accessor(SQUARE + np.array([2 * number, 0, 0], np.float32)),
            "TEXCOORD_0": build.accessor(uvs),
        }
        primitives.append({"attributes": attributes, "indices": build.accessor(SQUARE_TRIANGLES), "material": number})
    images = [picture(5, 16, 16), picture(6, 8, 24)]
    views = [{"bufferView": build.view(encode_png(image)), "mimeType": "image/png"} for image in images]
    factor = [0.5, 0.1, 0.9]
    materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": number}}} for number in range(2)]
    materials.append({"pbrMetallicRoughness": {"baseColorFactor": [*factor, 1.0]}})
    build.root |= {
        "images": views,
        "textures": [{"source": 0}, {"extensions": {"EXT_texture_webp": {"source": 1}}}],
        "materials": materials,
        "meshes": [{"primitives": primitives}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    mesh = read_gltf_mesh(build.save(tmp_path / "three.gltf"))
    assert len(mesh.vertices) == 12
    places = (mesh.vertices[mesh.faces].mean(1) / 1000)[:, :2]
    middle = torch.full((1, 3), 1 / 3)
    for triangle, (x, y) in enumerate(places.tolist()):
        number = int(x // 2)
        at = torch.tensor([[x - 2 * number, y]])
        own = to_srgb(torch.tensor(factor))[None] if number == 2 else sample_texture(images[number], at)
        assert torch.allclose(shown(mesh, triangle, middle), own, atol=1e-3)
