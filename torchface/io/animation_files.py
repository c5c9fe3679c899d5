"""Animated rigs by path: glTF and USD."""

from __future__ import annotations

from pathlib import Path

from torchface.errors import FileFormatError
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.io.gltf import read_gltf_weights
from torchface.io.rig_files import write_rig
from torchface.io.scenes.weight_keys import ShapeMatch, weight_keys
from torchface.io.usd import USD_ENDINGS, read_usd_weights
from torchface.rig import BlendshapeRig
from torchface.take import Take


def save_animation(
    rig: BlendshapeRig, take: Take, path: str | Path, detail: DetailMaps | RegionMaps | None = None
) -> ShapeMatch:
    """Writes a rig with the take's weights as its animation, a key a frame at its time, linear between.

    Correctives get the weights that the shapes' call for, so that the animation plays everywhere.

    Args:
        rig: the rig.
        take: with ``weights``; names are matched by ``shape_names.mapping``.
        path: a ``.glb``, or ``.usda``, ``.usdc``, ``.usd`` or ``.usdz``; it appears only when it is complete.
        detail: wrinkle maps of the rig's shapes, or of its regions, for ``.glb`` alone.

    Returns:
        ``ShapeMatch(driven, missing, unused)``.

    Raises:
        NameMismatchError: no channel drives any shape, or a wrinkle map belongs to none.
        ValueRangeError: the take has no weights or no frame, or a weight is NaN.
        FileFormatError: another ending, or the folder cannot be written to.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface import BlendshapeRig, Take, Track
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3), ["jawOpen"])
        >>> take = Take(30.0, weights=Track(("JawOpen", "tongueOut"), torch.rand(4, 2, 1)))
        >>> save_animation(rig, take, "take.glb")
        ShapeMatch(driven=('jawOpen',), missing=(), unused=('tongueOut',))
    """
    check_animation_ending(path)
    keys, match = weight_keys(rig, take)
    write_rig(rig, path, detail, keys)
    return match


def check_animation_ending(path: str | Path) -> None:
    """Refuses what no animation can be written to.

    Raises:
        FileFormatError: another ending than ``.glb`` and USD's.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".glb", *USD_ENDINGS):
        raise FileFormatError(f"{path}: found the ending {suffix!r}, expected .glb or {', '.join(USD_ENDINGS)}")


def load_animation(path: str | Path) -> Take | None:
    """The weights that a file's animation gives its shapes, one frame a key; none where nothing moves shapes.

    Args:
        path: a ``.glb``, ``.gltf`` or USD file whose keys are a film's frames, as :func:`save_animation` writes them.

    Returns:
        weights (T,N,1), by the names of the shapes; correctives follow them and are left out. Frames that come unevenly
        have their times in ``extras["seconds"]``, from 0.

    Raises:
        FileFormatError: another kind of file, broken, or keys that are no frames: out of order, or with gaps of ten
            frames.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface import BlendshapeRig, Take, Track
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3), ["jawOpen"])
        >>> take = Take(30.0, weights=Track(("jawOpen",), torch.linspace(0, 1, 5)[:, None, None]))
        >>> _ = save_animation(rig, take, "take.glb")
        >>> load_animation("take.glb").weights.values.flatten().tolist()
        [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    if Path(path).suffix.lower() in USD_ENDINGS:
        return read_usd_weights(path)
    return read_gltf_weights(path)
