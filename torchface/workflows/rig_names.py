"""Under which names a rig's shapes are written."""

from typing import Literal

from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, arkit_sources

Naming = Literal["arkit"]


def renamed(rig: BlendshapeRig, names: Naming | None) -> BlendshapeRig:
    """The rig as it is written: under ARKit's names, or its own where ``names`` is absent."""
    return rig if names is None else rig.with_arkit_names()


def renamed_detail(detail: DetailMaps | None, rig: BlendshapeRig, names: Naming | None) -> DetailMaps | None:
    """Detail maps for ``renamed(rig, names)``."""
    if names is None or detail is None:
        return detail
    return detail.merged({name: [rig.names[row] for row in rows] for name, rows in arkit_sources(rig.names).items()})


def naming_lines(rig: BlendshapeRig, names: Naming | None) -> list[str]:
    """Which shapes are ARKit's, for people to read; none under the rig's own names."""
    if names is None:
        return []
    written = rig.with_arkit_names().names
    own, missing = [name for name in written if name not in ARKIT], [name for name in ARKIT if name not in written]
    line = f"names: {len(written) - len(own)} of ARKit's 52"
    line += f"; it has no {', '.join(own)}, which keep their names" if own else ""
    return [line + (f"; the rig has no {', '.join(missing)}" if missing else "")]
