"""Annotations of the head's vertices: 68 landmarks, regions, pairs that touch."""

from functools import lru_cache

import torch
from torch import Tensor

from torchface.mesh import Annotations
from torchface.synthetic.head.facial_openings import lid_order, lip_order
from torchface.synthetic.head.identity import both_sides, sculpted_vertices
from torchface.synthetic.head.topology import EAR, EYE_RIM, MOUTH_BORDER, MOUTH_CONTACT, NOSTRIL_RIM, Topology, topology

# The left half of the jaw's contour from the ear to before the chin, and of the brow from its inner to its outer end.
_JAW = (
    (69, -12, 12), (67, -28, 14), (64, -46, 16), (58.5, -64, 20),
    (50.5, -81, 30), (40.5, -94, 46), (29.5, -104, 62), (16, -110, 76),
)  # fmt: skip
_BROW = ((9.5, 17.5, 92), (18, 20.5, 90), (28, 22.5, 86), (38.5, 21.5, 79), (48, 16.5, 68))
_NOSE_BRIDGE = (6.5, -7.0, -20.0, -33.5)


@lru_cache(maxsize=1)
def head_annotations() -> Annotations:
    """The same for every head."""
    t = topology()
    contacts = _contacts(t)
    return Annotations(_landmarks(t), _regions(t), t.mirror.clone(), contacts)


def _outer_skin(t: Topology) -> Tensor:
    """Half-head vertices that show when mouth and eyes are closed."""
    skin = torch.zeros(t.half_count, dtype=torch.bool)
    skin[t.grid[t.grid >= 0]] = True
    skin[t.rings["mouth"][: MOUTH_BORDER + 1]] = True
    skin[t.rings["eye"][: EYE_RIM + 1]] = True
    skin[t.rings["nostril"][: NOSTRIL_RIM + 1]] = True
    return skin


def _nearest(spots: tuple[tuple[float, float, float], ...], allowed: Tensor) -> Tensor:
    p = sculpted_vertices()[: len(allowed)]
    distance = torch.cdist(torch.tensor(spots, dtype=p.dtype), p)
    return distance.masked_fill(~allowed, torch.inf).argmin(1)


def _landmarks(t: Topology) -> Tensor:
    p = sculpted_vertices()[: t.half_count]
    skin = _outer_skin(t)
    twin = t.mirror
    jaw = _nearest(_JAW, skin)
    middle = skin & t.midline & (p[:, 2] > 30)
    spots = tuple((0.0, y, 90.0) for y in _NOSE_BRIDGE)
    chin = _nearest(((0.0, -115.0, 80.0),), middle)
    brow = _nearest(_BROW, skin)
    bridge = torch.stack([
        (p[:, 1] - y).abs().masked_fill(~middle, torch.inf).argmin() for _, y, _ in spots
    ])  # fmt: skip
    base = t.grid[21, :1]
    wings = _nearest(((7.0, -45.0, 92.0), (14.0, -42.5, 90.5)), skin)
    rim, (above, below) = t.rings["eye"][EYE_RIM], lid_order()
    corner_in, corner_out = rim[above[0]], rim[above[16]]
    left_eye = torch.stack([corner_in, rim[above[5]], rim[above[11]], corner_out, rim[below[11]], rim[below[5]]])
    right_eye = twin[torch.stack([corner_out, rim[above[11]], rim[above[5]], corner_in, rim[below[5]], rim[below[11]]])]
    red, line = t.rings["mouth"][MOUTH_BORDER], t.rings["mouth"][MOUTH_CONTACT]
    upper, lower = lip_order()
    out = (3, 8)  # steps from the midline: the bow's peak, half way to the corner
    outer = torch.cat([
        twin[line[13]].view(1), twin[red[upper[out[1]]]].view(1), twin[red[upper[out[0]]]].view(1), red[:1],
        red[upper[list(out)]], line[13:14], red[lower[[8, 4]]], red[26:27], twin[red[lower[[4, 8]]]],
    ])  # fmt: skip
    inner = torch.cat([
        twin[line[12]].view(1), twin[line[upper[5]]].view(1), line[:1], line[upper[5]].view(1),
        line[12].view(1), line[lower[5]].view(1), line[26:27], twin[line[lower[5]]].view(1),
    ])  # fmt: skip
    return torch.cat([
        twin[jaw], chin, jaw.flip(0), twin[brow.flip(0)], brow, bridge,
        twin[wings.flip(0)], base, wings, right_eye, left_eye, outer, inner,
    ])  # fmt: skip


def _contacts(t: Topology) -> Tensor:
    above, below = lid_order()
    upper, lower = lip_order()
    pairs = []
    for side in (0, 1):
        for ring in (EYE_RIM, EYE_RIM + 1):
            lid = both_sides(t.rings["eye"])[side][ring]
            pairs.append(torch.stack([lid[above[1:-1]], lid[below[1:-1]]], dim=1))
        lip = both_sides(t.rings["mouth"])[side][MOUTH_CONTACT]
        first = side  # the midline pair belongs to both sides: once is enough
        pairs.append(torch.stack([lip[upper[first:-1]], lip[lower[first:-1]]], dim=1))
    return torch.cat(pairs)


def _regions(t: Topology) -> dict[str, Tensor]:
    p = sculpted_vertices()
    x, y, z = p[:, 0].abs(), p[:, 1], p[:, 2]
    left = p[:, 0] > -1e-9
    none = torch.zeros(t.count, dtype=torch.bool)

    def marked(*parts: Tensor, side: int | None = None) -> Tensor:
        mask = none.clone()
        for part in parts:
            for which in (0, 1) if side is None else (side,):
                mask[both_sides(part[part >= 0])[which]] = True
        return mask

    eye, mouth = t.rings["eye"], t.rings["mouth"]
    balls = (t.eyeball, t.caps["eyeball_front"], t.caps["eyeball_back"])
    sockets = marked(eye[EYE_RIM + 2 :], t.caps["eye"])
    interior = marked(mouth[MOUTH_CONTACT + 1 :], t.caps["mouth"])
    ears = marked(t.rings["ear"][1:], t.caps["ear"])
    nostrils = marked(t.rings["nostril"][NOSTRIL_RIM + 1 :], t.caps["nostril"])
    hidden = marked(*balls) | sockets | interior | nostrils
    skin = ~hidden & ~ears
    cranium = skin & ((y > 58) | ((z < 5 + 0.15 * y) & (y > -45)))
    neck = skin & ((y < -116) | ((z < 25 - 0.55 * (y + 110)) & (y < -100)) | ((z < 5) & (y < -45)))
    face = skin & ~cranium & ~neck
    upper_lip, lower_lip = marked(mouth[MOUTH_BORDER:, :14]), marked(mouth[MOUTH_BORDER:, 13:])
    lids = marked(eye[2 : EYE_RIM + 2])
    nose = face & (x < 19) & (y < 6) & (y > -45) & (z > 84 - 0.30 * x) & ~lids
    brow_line = 17.5 + 5 * (1 - ((x - 28) / 20) ** 2)
    brows = face & ((y - brow_line).abs() < 5.5) & (x > 7) & (x < 51)
    lips = (upper_lip | lower_lip) & ~interior
    chin = face & (y < -80) & (x < 24) & ~lips
    jaw = face & (y < -58) & (x >= 24) & ~lips
    cheeks = face & (y < -8) & (y > -80) & (x > 19) & ~lids & ~lips & ~nose
    regions = {
        "face": face, "forehead": face & (y > 24) & ~brows, "brow_left": brows & left, "brow_right": brows & ~left,
        "lids_left": lids & left, "lids_right": lids & ~left,
        "eye_left": marked(eye, t.caps["eye"], *balls, side=0), "eye_right": marked(eye, t.caps["eye"], *balls, side=1),
        "eyeball_left": marked(*balls, side=0), "eyeball_right": marked(*balls, side=1), "eye_sockets": sockets,
        "nose": nose, "nostrils": nostrils, "cheek_left": cheeks & left, "cheek_right": cheeks & ~left,
        "upper_lip": upper_lip & ~interior, "lower_lip": lower_lip & ~interior, "mouth_interior": interior,
        "chin": chin, "jaw": jaw, "ear_left": ears & left, "ear_right": ears & ~left,
        "neck": neck, "cranium": cranium,
    }  # fmt: skip
    assert EAR.rings == len(t.rings["ear"]) - 1
    return regions
