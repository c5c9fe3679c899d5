"""Rigs, their animations and detail maps by path: glTF, USD, a folder of OBJ files, ICT-FaceKit's folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.files.whole_files import check_ending
from torchface.geometry.meshes.normal_maps import DetailMaps, SurfaceMaps
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.detail_textures import read_gltf_detail
from torchface.io.gltf.gltf_reading import read_gltf_rig
from torchface.io.gltf.gltf_writing import write_gltf_rig
from torchface.io.maya.maya_writing import MAYA_ENDING, write_maya_rig
from torchface.io.rigs.ict_facekit import is_ict_folder, load_ict_facekit, region
from torchface.io.rigs.rig_folder import load_obj_folder, save_obj_folder
from torchface.io.scenes.weight_keys import ShapeMatch, WeightKeys, common_keys, keys_of_curves, weight_keys
from torchface.io.usd.usd_library import require_usd
from torchface.io.usd.usd_reading import read_usd_detail, read_usd_rig, read_usd_weights
from torchface.io.usd.usd_writing import USD_ENDINGS, write_usd_rig
from torchface.number_checks import checked_path, checked_type
from torchface.rig import BlendshapeRig
from torchface.take import Take
from torchface.temporal.key_reduction import KeyReduction

GLTF_ENDINGS = (".glb", ".gltf", ".vrm")
SCENE_ENDINGS = (*GLTF_ENDINGS, *USD_ENDINGS)  # files that may hold a rig, or a mesh without shapes
ANIMATION_ENDINGS = (".glb", *USD_ENDINGS, MAYA_ENDING)  # files that a rig is written to with an animation


def load_rig(
    path: str | Path,
    unit: str | None = None,
    part: str | None = None,
    shapes: Sequence[str] | None = None,
    neutral: str | None = None,
) -> BlendshapeRig:
    """A rig in millimetres from where its authors left it.

    Args:
        path: a ``.glb``, ``.gltf`` or ``.vrm`` with morph targets; a ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` with
            blend shapes; ICT-FaceKit's ``FaceXModel`` folder; or a folder of OBJ files, one of them neutral, every
            other a shape of its file's name.
        unit: ``"um"``, ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``; if absent metres for glTF, what the file says for
            USD, centimetres for ICT, millimetres for OBJ.
        part: keep this annotated region only, such as ``"face"`` of an ICT head.
        shapes: keep these, in this order; all (for ICT the 53 expressions) if absent.
        neutral: the name of the neutral's file in an OBJ folder; if absent the one with "neutral" in it.

    Raises:
        FileFormatError: the path is missing or none of these, or a file is broken; the message names it.
        NameMismatchError: a shape or part that is not there.
        TopologyError: shapes of different vertex counts or faces.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface.synthetic import performer
        >>> save_rig(performer(texture=False), "actor.glb")
        >>> load_rig("actor.glb", shapes=["jawOpen", "mouthClose"])
        BlendshapeRig(Mesh(6419 vertices, 12760 triangles, 6380 polygons), 2 shapes)
    """
    checked_path("path", path)
    path = Path(path)
    if path.is_dir():
        if is_ict_folder(path) and neutral is None:
            return load_ict_facekit(path, shapes, part, unit)
        rig = load_obj_folder(path, unit or "mm", neutral)
    elif path.suffix.lower() in USD_ENDINGS:
        rig = read_usd_rig(path, unit)
    elif path.suffix.lower() in GLTF_ENDINGS or not path.exists():
        rig = read_gltf_rig(path, unit or "m")
    else:
        raise FileFormatError(
            f"{path}: found a file that is no {', '.join(SCENE_ENDINGS)}, expected one, or a folder of OBJ files"
        )
    rig = rig if shapes is None else rig.select(shapes)
    return rig if part is None else rig.part(region(rig.neutral, part))


def save_rig(rig: BlendshapeRig, path: str | Path, detail: DetailMaps | RegionMaps | SurfaceMaps | None = None) -> None:
    """Writes a rig for other programs, and so that ``load_rig`` gives the same one.

    Args:
        rig: the rig.
        path: a ``.glb`` (metres; parts that regions name have materials of their own; shapes are sparse morph targets,
            correctives among them); a ``.usda``, ``.usdc``, ``.usd`` or ``.usdz``; a ``.ma`` for Maya, which
            ``load_rig`` does not read; or a name without an ending, for a folder of ``neutral.obj`` and an OBJ a shape.
            It appears only when it is complete.
        detail: detail maps of its shapes, or of its regions, or the surface's normals and roughness, for ``.glb``
            alone.

    Raises:
        FileFormatError: another ending, a folder that holds another rig, or one that cannot be written to.
        TopologyError: for a file the mesh has no triangle, or detail maps and no texture coordinates.
        NameMismatchError: a detail map belongs to no shape of the rig, or a shape's name is no file's name.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3), ["jawOpen"])
        >>> save_rig(rig, "actor")
        >>> sorted(path.name for path in Path("actor").iterdir())
        ['jawOpen.obj', 'neutral.obj', 'rig.json']
    """
    checked_type("rig", rig, BlendshapeRig)
    checked_path("path", path)
    write_rig(rig, path, detail, None)


def write_rig(
    rig: BlendshapeRig, path: str | Path, detail: DetailMaps | RegionMaps | SurfaceMaps | None, keys: WeightKeys | None
) -> None:
    """Writes a rig, with ``keys`` as the animation of its shapes; see :func:`save_rig`."""
    check_rig_ending(path)
    suffix = Path(path).suffix.lower()
    if suffix == ".glb":
        write_gltf_rig(rig, path, detail, keys)
    elif isinstance(detail, RegionMaps | SurfaceMaps):
        kind = f"a {suffix} file" if suffix else "a folder of OBJ files"
        found = "wrinkle maps by region" if isinstance(detail, RegionMaps) else "maps of the surface"
        raise FileFormatError(f"{path}: found {found} for {kind}, expected .glb for them")
    elif suffix in USD_ENDINGS:
        write_usd_rig(rig, path, keys, detail)
    elif suffix == MAYA_ENDING:
        if detail is not None:
            raise FileFormatError(f"{path}: found detail maps for a {suffix} file, expected .glb or USD for them")
        write_maya_rig(rig, path, keys)
    else:
        save_obj_folder(rig, path, detail)


def save_animation(
    rig: BlendshapeRig,
    take: Take,
    path: str | Path,
    detail: DetailMaps | RegionMaps | SurfaceMaps | None = None,
    reduce: float | None = None,
) -> ShapeMatch:
    """Writes a rig with the take's weights as its animation, a key a frame at its time, linear between.

    Correctives get the weights that the shapes' call for, so that the animation plays everywhere.

    Args:
        rig: the rig.
        take: with ``weights``; names are matched by ``shape_names.mapping``.
        path: a ``.glb``, ``.usda``, ``.usdc``, ``.usd``, ``.usdz`` or ``.ma``; it appears only when it is complete.
        detail: detail maps of the rig's shapes, or of its regions, for ``.glb`` alone.
        reduce: keep as few keys as stay within this of every frame's weights; all if absent.

    Returns:
        ``ShapeMatch(driven, missing, unused, reduction)``.

    Raises:
        NameMismatchError: no channel drives any shape, or a detail map belongs to none.
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
    checked_type("rig", rig, BlendshapeRig)
    checked_type("take", take, Take)
    checked_path("path", path)
    check_ending(path, *ANIMATION_ENDINGS)
    keys, match = weight_keys(rig, take)
    keys, reduction = reduced_keys(rig, keys, path, reduce)
    write_rig(rig, path, detail, keys)
    return replace(match, reduction=reduction)


def reduced_keys(
    rig: BlendshapeRig, keys: WeightKeys, path: str | Path, bound: float | None
) -> tuple[WeightKeys, KeyReduction | None]:
    """Few keys within a bound, as the kind of file has them; all without a bound."""
    if bound is None:
        return keys, None
    return keys_of_curves(keys, bound) if Path(path).suffix.lower() == MAYA_ENDING else common_keys(rig, keys, bound)


def load_animation(path: str | Path) -> Take | None:
    """The weights that a file's animation gives its shapes, one frame a key; none where nothing moves shapes.

    Args:
        path: a ``.glb``, ``.gltf`` or USD file, as :func:`save_animation` or another program writes it.

    Returns:
        weights (T,N,1), by the names of the shapes; correctives follow them and are left out. Keys that come unevenly
        keep their times; steps and cubic splines between keys further apart than a film's are sampled, at 30 frames a
        second where the keys lie on such frames.

    Raises:
        FileFormatError: another kind of file, broken, or keys out of order.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface import BlendshapeRig, Take, Track
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3), ["jawOpen"])
        >>> take = Take(30.0, weights=Track(("jawOpen",), torch.linspace(0, 1, 5)[:, None, None]))
        >>> _ = save_animation(rig, take, "take.glb")
        >>> load_animation("take.glb").weights.values.flatten().tolist()
        [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    checked_path("path", path)
    if Path(path).suffix.lower() in USD_ENDINGS:
        return read_usd_weights(path)
    return read_gltf_weights(path)


def load_detail_maps(path: str | Path) -> DetailMaps | None:
    """The detail maps of a rig's file; none where it has neither such maps nor a normal texture.

    Args:
        path: a ``.glb``, ``.gltf`` or USD file.

    Raises:
        FileFormatError: another kind of file, a broken list, images of different sizes, or more of them than the file
            can hold.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface.io import save_mesh
        >>> from torchface.synthetic import neutral_head
        >>> save_mesh(neutral_head(texture=False), "smooth.glb")
        >>> load_detail_maps("smooth.glb") is None
        True
    """
    checked_path("path", path)
    if Path(path).suffix.lower() in USD_ENDINGS:
        return read_usd_detail(path)
    return read_gltf_detail(path)


def check_rig_ending(path: str | Path) -> None:
    """Refuses what no rig can be written to."""
    suffix = Path(path).suffix.lower()
    if suffix not in ("", *ANIMATION_ENDINGS):
        known = ", ".join(ANIMATION_ENDINGS)
        raise FileFormatError(
            f"{path}: found the ending {suffix!r}, expected {known}, or none for a folder of OBJ files"
        )
    if suffix in USD_ENDINGS:
        require_usd()
