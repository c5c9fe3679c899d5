"""Light of a photograph, its exposure first, estimated on the face and divided out of its colours."""

import math

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.rendering.camera_visibility import Shown
from torchface.rendering.environment_light import EnvironmentLight, harmonics

_SQUARE, _LEAST = 0.3, 60
_UNLIKE = 0.18  # of a logarithm: shadows, stubble and highlights further off count little
_ROUNDS = 8
# Precision of the first and second degree beside as many vertices as count: cheeks and beards are no light.
_HELD = (0.0, *(0.02,) * 3, *(0.10,) * 5)
_HELD_TO_GREY = 0.3
_FAINT, _BRIGHT, _TINT = 0.4, 2.2, 1.12  # beside the mean: what the estimate may divide by
_PATCH = 4  # rounds over the mesh: what is smaller is the skin's own
# Logarithms of sRGB by which one person's skin differs over the face, and half of that between its sides.
_OWN_TONE, _OWN_HUE, _TWIN = 0.2, 0.12, 0.04
_BESIDE_HAIR = 0.25  # of these where skin may lie in its shadow
_BOTH = 0.2  # share of skin from which both sides are compared
_PEOPLE_HUE = (0.15, 0.06, 0.15)  # of the channels, by which skins of people differ from the colour model
_AROUND = 40  # rounds
_SURE, _DARKEST = 0.5, 0.02


# In linear light: what is brightest in a picture that is well exposed, fair skin, and the white of an eye in the lids'
# shade there: in 9 good photographs 0.31 to 0.66, in 4 dim ones 0.09 to 0.20.
_WHITE, _FAIR, _EYE_WHITE = 0.91, 0.36, 0.3
_BRIGHTEST, _EYE = 0.99, 0.95  # quantiles
_BRIGHTER = 5.0  # at most: what is darker shows noise beside its colours
_GLINT = 8.0  # times as bright as skin: no white of an eye is, but light in glasses
_EYE_PIXELS = 10  # of the crop
# How much redder than blue skin is, sRGB: 1.32 to 2.15 in 24 photographs, 1.25 to 1.39 in washed-out films.
_REDNESS, _COLORLESS = 1.45, 0.04
_HEAD, _DARKEST_SHARE = ("skin", "hair", "brows", "eyes", "lips", "teeth"), 0.005


def exposure_gain(image: Tensor, parts: FaceParts) -> float:
    """What a photograph's light is multiplied by, at most 5, to be well exposed; what is too dark shows nobody's
    complexion."""
    return min(needed_gain(image, parts), _BRIGHTER)


def needed_gain(image: Tensor, parts: FaceParts) -> float:
    """What would make a photograph well exposed, however dark it is; see :func:`exposure_gain`.

    By what is brightest in the whole picture and about the face; but not so far that its skin is more than fair, or the
    whites of the eyes brighter than in good light: beside a dark complexion they are bright in a dim picture too.
    """
    image = image[:3]
    crop = to_linear(parts.crop(image)).double()
    eyes, skin = (crop[:, parts.of(name) > _SURE].mean(0) for name in ("eyes", "skin"))
    whole, near = (one.double().amax(0).flatten() for one in (to_linear(image), crop))
    brightest = [float(one.kthvalue(1 + int(_BRIGHTEST * (len(one) - 1))).values) for one in (whole, near)]
    gain = math.prod(max(1.0, _WHITE / max(one, 0.01)) for one in brightest) ** 0.5
    limits = [_FAIR / max(float(skin.median()), 1e-3)] if len(skin) else []
    white = max(float(eyes.quantile(_EYE)), 1e-3) if len(eyes) >= _EYE_PIXELS else torch.inf
    limits += [_EYE_WHITE / white] if len(skin) and white < _GLINT * float(skin.median()) else []
    return max(1.0, min([gain, *limits]))


def exposed(image: Tensor, parts: FaceParts) -> Tensor:
    """A photograph (3,H,W), sRGB, as a well exposed one, see :func:`exposure_gain`, without a veil over its colours."""
    image = unveiled(image, parts)
    return to_srgb((to_linear(image) * exposure_gain(image, parts)).clamp(0, 1))


def unveiled(image: Tensor, parts: FaceParts) -> Tensor:
    """A photograph (3,H,W), sRGB, without the grey that a webcam or a bad lens adds to all colours.

    As much is taken away as makes skin as red as that of people, but no more than is in the darkest of the head; skin
    stays as bright as it was. Grey photographs and those in blue light, whose skin would get bluer, stay as they are.
    """
    crop = parts.crop(image)
    is_skin, head = parts.of("skin") > _SURE, parts.of(*_HEAD) > _SURE
    if int(is_skin.sum()) < _LEAST:
        return image
    skin = crop[:, is_skin].median(1).values
    dark = torch.nn.functional.avg_pool2d(crop[None], 3, 1, 1, count_include_pad=False)[0].mean(0)[head]
    veil = min(float(_REDNESS * skin[2] - skin[0]) / (_REDNESS - 1), float(dark.quantile(_DARKEST_SHARE)))
    if veil <= 0 or float(skin[0] - skin[2]) < _COLORLESS:
        return image
    return ((image - veil) * float(skin.mean() / (skin.mean() - veil))).clamp(0, 1)


def skin_light(shown: Shown, normals: Tensor, camera: Camera, skin: Tensor) -> EnvironmentLight | None:
    r"""The light in which a photograph shows skin of one colour, in mean 1; None where it shows too little of it.

    .. math:: \min_L \sum_v \rho\bigl(\log c_v - \log \rho_0 L(n_v)\bigr) + \lVert L \rVert^2_\Lambda

    First for the mean of the channels, then for each, held to that: what is red all over is the skin, not the light.

    Args:
        normals: unit, (V,3), in the world.
        skin: vertices that are surely skin, (V,) bool.

    Source: Ramamoorthi and Hanrahan 2001 (irradiance in spherical harmonics).
    """
    rows = (skin & (shown.cosine > _SQUARE)).nonzero()[:, 0]
    if len(rows) < _LEAST:
        return None
    colors = to_linear(shown.colors[rows].double().clamp(0.01, 1))
    basis = harmonics(in_camera(normals[rows], camera))
    even = basis.new_zeros(basis.shape[1])
    even[0] = 1 / basis[0, 0]
    held = basis.new_tensor(_HELD).diag()
    grey = _fitted(colors.mean(1), basis, even, held)
    held_to_grey = held + _HELD_TO_GREY * torch.eye(len(even), dtype=torch.float64)
    channels = [_fitted(colors[:, k], basis, grey, held_to_grey) for k in range(3)]
    return EnvironmentLight(torch.stack(channels, dim=1))


def _fitted(color: Tensor, basis: Tensor, goal: Tensor, held: Tensor) -> Tensor:
    """Harmonics (9,) of light that is 1 in the mean over the vertices, by reweighted least squares."""
    weight, light = torch.ones_like(color), goal
    for _ in range(_ROUNDS):
        level = (color / (basis @ light).clamp(min=0.1)).log()
        albedo = ((weight * level).sum() / weight.sum()).exp()
        apart = (level - albedo.log()) / _UNLIKE
        weight = 1 / (1 + apart.square())
        total = weight.sum()
        H = (basis * weight[:, None]).T @ basis / total + held
        light = torch.linalg.solve(H, (basis * weight[:, None]).T @ (color / albedo) / total + held @ goal)
        light = light / ((weight * (basis @ light)).sum() / total).clamp(min=0.1)
    return light


def unlit(colors: Tensor, normals: Tensor, camera: Camera, light: EnvironmentLight | None) -> Tensor:
    """Colours (Q,3), sRGB, of a photograph at points with normals (Q,3) in even light of the same brightness."""
    if light is None:
        return colors
    shade = light.irradiance(in_camera(normals.double(), camera))
    grey = shade.mean(-1, keepdim=True).clamp(_FAINT, _BRIGHT)
    tint = (shade / grey).clamp(1 / _TINT, _TINT)  # what is dark has hardly a hue to be divided by
    return to_srgb((to_linear(colors.double().clamp(0, 1)) / (grey * tint)).clamp(0, 1)).to(colors)


def light_hue(colors: Tensor, skin: Tensor, tone: Tensor | None) -> Tensor:
    """The hue of a coloured light, (3,) of mean 1 in sRGB: how far skin's hue lies beyond that of people's.

    Of colours (V,3) in even light and how surely they are skin (V,); the light is white without a tone (V,3) of a skin
    like it.
    """
    sure = skin > _SURE
    if tone is None or int(sure.sum()) < _LEAST:
        return torch.ones(3, dtype=torch.float64)
    apart = (_log(colors[sure]) - _log(tone[sure])).median(0).values
    hue, limit = apart - apart.mean(), apart.new_tensor(_PEOPLE_HUE)
    return (hue - torch.maximum(torch.minimum(hue, limit), -limit)).exp()


def patch_offset(
    colors: Tensor,
    skin: Tensor,
    tone: Tensor | None,
    graph: VertexGraph,
    mirror: Tensor | None = None,
    doubt: Tensor | None = None,
) -> Tensor:
    """What takes away shadows that the face throws on itself and highlights that ``skin_light`` leaves, (V,3).

    One person's skin differs little over the face, and alike on both sides, as blush and stubble do: colours that lie
    further from its tone than that are brought near it, sooner where the other side differs; brightness and hue apart.
    What is no skin takes the offset of the skin around it.

    Args:
        colors: in even light, sRGB (V,3).
        skin: how surely each vertex is seen to be skin, (V,) in [0,1].
        tone: of a skin like it, (V,3); one for all vertices if absent.
        mirror: of each vertex its twin on the other side, (V,).
        doubt: how much each may lie in the shadow of hair, (V,) in [0,1]; nowhere if absent.

    Returns:
        To be added to the colours, so that grain in dark places is not multiplied.
    """
    if int((skin > _SURE).sum()) < _LEAST:
        return torch.zeros_like(colors, dtype=torch.float64)
    broad = graph.smoothed(colors.double(), skin, _PATCH)
    like = torch.zeros_like(broad) if tone is None else _log(graph.smoothed(tone.double(), skin, _PATCH))
    apart = _log(broad) - like
    sure = skin if doubt is None else skin * (1 - doubt)
    own = apart[(sure if int((sure > _SURE).sum()) >= _LEAST else skin) > _SURE].median(0).values
    apart = apart - own
    seen = graph.smoothed(skin[:, None], torch.ones_like(skin), _PATCH).clamp(max=1)
    twin = torch.zeros_like(apart)
    if mirror is not None:
        both = torch.minimum(seen, seen[mirror])
        twin = torch.where(both > _BOTH, 0.5 * (apart - apart[mirror]), 0.0)
    narrow = torch.ones_like(broad[:, :1]) if doubt is None else 1 - (1 - _BESIDE_HAIR) * doubt[:, None]
    wanted = (
        like + own + narrow * (_limited((apart - twin) / narrow, _OWN_TONE, _OWN_HUE) + _limited(twin, _TWIN, _TWIN))
    )
    offset = wanted.exp() - broad
    return torch.lerp(graph.smoothed(offset, seen[:, 0], _AROUND), offset, seen)


def like_skin_around(colors: Tensor, tone: Tensor, most: float, hue: float) -> Tensor:
    """Colours (P,3) of skin, as near to those of the skin around, (P,3), as pores and wrinkles are.

    Logarithms of their brightness differ by ``most``, those of their channels beside it by ``hue``.

    What ``patch_offset`` leaves at the sharp edges of shadows differs far more, and in hue.
    """
    apart = _log(colors) - _log(tone)
    level = apart.mean(1, keepdim=True)
    return (_log(tone) + most * (level / most).tanh() + (apart - level).clamp(-hue, hue)).exp()


def _limited(apart: Tensor, tone: float, hue: float) -> Tensor:
    """Differences (V,3) of colours, limited in brightness and in hue."""
    level = apart.mean(1, keepdim=True)
    return level.clamp(-tone, tone) + (apart - level).clamp(-hue, hue)


def _log(colors: Tensor) -> Tensor:
    return colors.double().clamp(min=_DARKEST).log()


def in_camera(normals: Tensor, camera: Camera) -> Tensor:
    """Directions (...,3) of the world in the camera's frame."""
    return normals.double() @ camera.rotation.double().T
