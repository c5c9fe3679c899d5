"""A fitted head as a character: the template's teeth, tongue, lashes, hair and collar in its photographs' colours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.meshes.normal_maps import SurfaceMaps
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.modeling import ImageFit
from torchface.modeling.photographs.eye_color import IRIS_WIDTH, with_iris
from torchface.modeling.photographs.hair_cap import hangs_down
from torchface.modeling.photographs.image_texture import without_colors
from torchface.modeling.photographs.skin_light import exposed
from torchface.registration import hidden_parts, with_template_skin
from torchface.rig import BlendshapeRig
from torchface.synthetic import Look, character
from torchface.synthetic.head.skin_texture import IRIS_EDGE

_SIZE = 1024
_CLOTH, _LEAST = 0.7, 150  # share and crop's pixels
# Of teeth and whites of eyes: share and crop's pixels, which quantile of the pixels, the usual brightness of those
# painted, how dark they get. Teeth that no picture shows are as bright as lips let them be in those that do.
_SHOWN, _TEETH_PIXELS, _WHITE_PIXELS = 0.5, 20, 10
_TEETH, _WHITES = (0.7, 0.86), (0.95, 0.83)
_DARKEST_PART, _BEHIND_LIPS = 0.6, 0.85


@dataclass(frozen=True, eq=False)
class DressedRig:
    """A person's rig with skin, and how that shades: its normals and roughness where the template has some."""

    rig: BlendshapeRig
    surface: SurfaceMaps | None = None


def dressed_rig(
    rig: BlendshapeRig,
    template: BlendshapeRig,
    fit: ImageFit,
    images: Sequence[Tensor],
    parts: Sequence[FaceParts],
    marks: Tensor,
    whole: bool,
    hats: bool = False,
) -> DressedRig:
    """A fitted rig with the skin of its photographs; ``template`` has the parts that nobody sees in them.

    A ``whole`` one is a character with teeth, tongue, lashes, hair and collar, for rigs of the performer's topology;
    the photographs' brows are its only ones. Its hair is as usual where they show ``hats`` alone, else where no hair is
    seen it is bald.
    """
    # Photographs show little of eyeballs and teeth: parts of their own keep the template's skin.
    unseen = hidden_parts(template.neutral, torch.zeros(len(template.vertices), dtype=torch.bool))
    neutral = with_template_skin(fit.mesh, template.neutral, unseen)
    if not whole:
        neutral = neutral if fit.iris is None else with_iris(neutral, fit.iris)
        own = BlendshapeRig(neutral, rig.deltas, rig.names)
        return DressedRig(_grey(own) if without_colors(images) else own)
    usual, shirt = Look(), _cloth(images, parts)
    look = Look(
        hair=usual.hair if fit.hair is None else _color(fit.hair),
        iris=usual.iris if fit.iris is None else _color(fit.iris),
        haircut=None if fit.hair is None and not hats else "long" if hangs_down(parts, marks) else "short",
        fringe=fit.fringe,
        shirt=usual.shirt if shirt is None else _color(shirt),
        iris_size=iris_size(neutral),
        **_brightness(images, parts),
    )
    skin = neutral.texture
    made = character(
        BlendshapeRig(neutral, rig.deltas, rig.names), look, _SIZE if skin is None else skin.shape[-1], skin
    )
    return DressedRig(_grey(made.rig) if without_colors(images) else made.rig, made.surface)


def iris_size(mesh: Mesh) -> float:
    """How much wider than painted on the performer's eyeballs irises of people's width are on those of a head."""
    ball = mesh.vertices[mesh.regions["eyeball_left"]]
    radius = 0.5 * float((ball.amax(0) - ball.amin(0)).mean())
    return math.asin(min(1.0, 0.5 * IRIS_WIDTH / radius)) / IRIS_EDGE


def _grey(rig: BlendshapeRig) -> BlendshapeRig:
    """A rig whose texture and colours have no hue, as its photographs have none."""
    skin, colors = rig.neutral.texture, rig.neutral.colors
    if skin is not None:
        skin = torch.cat([skin[:3].mean(0, keepdim=True).expand_as(skin[:3]), skin[3:]])
    if colors is not None:
        colors = colors.mean(1, keepdim=True).expand_as(colors)
    return BlendshapeRig(replace(rig.neutral, texture=skin, colors=colors), rig.deltas, rig.names)


def _brightness(images: Sequence[Tensor], parts: Sequence[FaceParts]) -> dict[str, float]:
    """How bright teeth and the whites of the eyes are in well exposed photographs, beside the usual."""
    teeth, eyes = (_pixels([exposed(*one) for one in zip(images, parts, strict=True)], parts, name, _SHOWN).mean(0)
        for name in ("teeth", "eyes"))  # fmt: skip
    whites = _beside(eyes, _WHITES) if len(eyes) >= _WHITE_PIXELS else 1.0
    return {"teeth": _beside(teeth, _TEETH) if len(teeth) >= _TEETH_PIXELS else _BEHIND_LIPS * whites, "whites": whites}


def _beside(light: Tensor, usual: tuple[float, float]) -> float:
    """A quantile of pixels' brightness (P,) beside the usual one."""
    return min(1.0, max(_DARKEST_PART, float(light.quantile(usual[0])) / usual[1]))


def _pixels(images: Sequence[Tensor], parts: Sequence[FaceParts], name: str, share: float) -> Tensor:
    """The colours (3,P) that crops of photographs have where they show a part by more than a share."""
    pairs = zip(images, parts, strict=True)
    return torch.cat([shown.crop(image)[:, shown.of(name) > share] for image, shown in pairs], 1)


def _cloth(images: Sequence[Tensor], parts: Sequence[FaceParts]) -> Tensor | None:
    """The colour of clothes, (3,); None where too little is seen."""
    colors = _pixels(images, parts, "cloth", _CLOTH)
    return colors.median(1).values if colors.shape[1] >= _LEAST else None


def _color(color: Tensor) -> tuple[float, float, float]:
    red, green, blue = color.tolist()
    return red, green, blue
