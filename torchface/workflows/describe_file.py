"""Contents of a file, in rows for people to read."""

from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import FileFormatError
from torchface.escaped_text import listed
from torchface.files.models import DESCRIPTION
from torchface.files.whole_files import check_there, read_file, visible_files
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.meshes.deformation import degenerate_triangles
from torchface.io import (
    HeadModelFile,
    load_animation,
    load_calibration,
    load_head_model_file,
    load_mesh,
    load_rig,
    load_take,
)
from torchface.io.gltf.gltf_reading import unread_textures
from torchface.io.head_models.array_files import ArrayFile
from torchface.io.head_models.head_model_files import is_head_model_file
from torchface.io.images.image_files import IMAGE_ENDINGS, load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.landmarks.landmark_points import load_landmark_points
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import GLTF_ENDINGS, SCENE_ENDINGS
from torchface.io.tables.csv_table import TableReader
from torchface.io.tables.numbered_csv import COLUMNS, read_numbered
from torchface.io.take_files import RECORDING_ENDINGS, TAKE_ENDINGS
from torchface.io.video import open_video
from torchface.io.video.video_file import VIDEO_ENDINGS
from torchface.io.weights.json_recordings import is_weight_json
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.shape_names.recognised_names import arkit_count, recognised_shapes
from torchface.take import Take
from torchface.workflows.named_finders import BUNDLE
from torchface.workflows.posed_mesh import load_neutral, several_heads, size_faults
from torchface.workflows.weight_files import weight_faults

if TYPE_CHECKING:  # solvers and onnx take seconds to load; few files need them
    import onnx

    from torchface.capture.anybody import ExampleShapes

Rows = list[tuple[str, str]]

_MAX_LENGTH = 240
_LENGTH, _LONGEST_HEADER = "_mm", 4096  # ends the names of columns that are no weights
_MAX_NAMED = 8
_STILL = 1e-5  # of a head's extent; by no more a shape moves nothing
_ALIKE = 0.01  # of a shape's motion: by no more its vertices differ where it moves the whole mesh
_LANDMARK_ENDINGS = (".ljson", ".pts", ".xml")
_ARRAY_ENDINGS = (".npz", ".npy", ".safetensors")


def describe(path: Path, attachment: Path | None = None, part: str | None = None) -> Rows:
    """Rows (what, value) about a mesh, rig, take, attachment, solver, video or image.

    Args:
        path: the file or folder.
        attachment: report which shapes of the rig its markers distinguish.
        part: this region of the rig only.

    Raises:
        FileFormatError: nothing that torchface reads.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        _check_rig_folder(path)
    if path.is_dir() or suffix in SCENE_ENDINGS:
        mesh, rig = load_neutral(path, part=part)
        if rig is None and attachment is None:
            return _with_texture_rows(path, _mesh_rows(mesh))
        rig = rig or load_rig(path, part=part)  # whose error says what is missing
        rows = [*_with_texture_rows(path, _rig_rows(rig)), *_animation_rows(path)]
        if part is None and (heads := several_heads(rig)):
            rows.append(("heads", heads))
        if attachment is not None:
            from torchface.capture.markers import MarkerSolver, observability

            where = Attachment.load(attachment)
            where.check(rig.neutral, attachment, path)
            moving = [name for name, delta in zip(rig.names, rig.deltas, strict=True) if bool(delta.any())]
            visible = observability(MarkerSolver(rig if rig.correctives else rig.select(moving), where))
            rows += [("what the markers see", str(visible))]
        return rows
    if attachment is not None:
        raise FileFormatError(f"{path}: found no rig, expected one to test the markers of {attachment} on")
    if suffix in MESH_ENDINGS:
        return _mesh_rows(load_mesh(path))
    if is_head_model_file(path):
        return _head_model_rows(load_head_model_file(path))
    if _is_error_table(path):
        return _error_rows(path)
    if suffix in (*TAKE_ENDINGS, *RECORDING_ENDINGS) and (suffix != ".json" or is_weight_json(path)):
        return _take_rows(load_take(path))
    if suffix == ".json":
        from torchface.capture.anybody.examples.example_shapes import ExampleShapes, is_examples

        if is_examples(path):
            return _example_rows(ExampleShapes.load(path))
        return _attachment_rows(Attachment.load(path))
    if suffix == ".onnx":
        return _graph_rows(path)
    if suffix == BUNDLE:
        from torchface.landmarks.images.face_landmarker.landmarker_bundle import load_bundle

        load_bundle(path)
        return [("Face Landmarker bundle", "finds landmarks: --landmarks of track, live, fit, examples and annotate")]
    if suffix == ".xml":
        faces = load_dlib_faces(path)
        marks = sorted({len(face.points) for face in faces})
        return [
            ("faces", f"{len(faces)} in {len({face.image for face in faces})} photographs"),
            ("landmarks", f"{', '.join(map(str, marks)) or 'none'} of a face, pixels"),
        ]
    if suffix in _ARRAY_ENDINGS:
        arrays = ArrayFile(path)
        return [(name, f"array ({','.join(map(str, arrays.shape(name)))})") for name in arrays.names]
    if suffix in _LANDMARK_ENDINGS:
        points = load_landmark_points(path).points
        unit = "the scan's unit" if points.shape[1] == 3 else "pixels"
        return [("landmarks", f"{len(points)}, {unit}"), (f"extent, {unit}", _extent(points[points.isfinite().all(1)]))]
    if suffix == ".toml":
        return _camera_rows(load_calibration(path))
    if suffix in VIDEO_ENDINGS:
        video = open_video(path)
        return [
            ("frames", f"{video.count} at {video.fps:g} a second, {video.count / video.fps:.1f} s"),
            ("pixels", f"{video.width} x {video.height}"),
        ]
    if suffix in IMAGE_ENDINGS:
        _, height, width = load_image(path).shape
        return [("pixels", f"{width} x {height}")]
    endings = (
        *SCENE_ENDINGS,
        *MESH_ENDINGS,
        *VIDEO_ENDINGS,
        *IMAGE_ENDINGS,
        *TAKE_ENDINGS,
        *RECORDING_ENDINGS,
        *_LANDMARK_ENDINGS,
        *_ARRAY_ENDINGS,
        BUNDLE,
        ".onnx",
        ".toml",
    )
    check_there(path)
    raise FileFormatError(
        f"{path}: found the ending {suffix!r}, expected a folder or one of {' '.join(sorted(endings))}"
    )


def _check_rig_folder(folder: Path) -> None:
    """Raises ``FileFormatError`` for folders that are no rig of OBJ files, with what holds what is in them."""
    if (folder / DESCRIPTION).is_file():
        raise FileFormatError(
            f"{folder}: found a learned model, expected a rig; `torchface zoo describe "
            f"{quote(str(folder))}` shows what is known of it"
        )
    scenes = [path.name for path in visible_files(folder, SCENE_ENDINGS)]
    if scenes and len(visible_files(folder, (".obj",))) < 2:
        raise FileFormatError(
            f"{folder}: found a folder with {_named(scenes)}, expected a file, such as {folder / scenes[0]}, or a "
            "folder of OBJ files, a neutral and one for each shape"
        )


def _camera_rows(camera: CameraCalibration) -> Rows:
    focal, centre = camera.intrinsics.diagonal()[:2].tolist(), camera.intrinsics[:2, 2].tolist()
    return [
        ("camera", f"{camera.width} x {camera.height} pixels"),
        ("focal length, pixels", f"{focal[0]:.1f}, {focal[1]:.1f}"),
        ("centre, pixels", f"{centre[0]:.1f}, {centre[1]:.1f}"),
        ("distortion", "none" if not bool(camera.distortion.any()) else str(camera.distortion.tolist())),
        ("error, pixels", "not measured" if camera.error is None else f"{camera.error:.2f}"),
    ]


def _is_error_table(path: Path) -> bool:
    """Whether a file is a table of lengths, as `arkit --animation` writes them, and not of weights."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with path.open(encoding="utf-8", errors="replace") as file:
        names = file.readline(_LONGEST_HEADER).strip().split(",")
    return len(names) > len(COLUMNS) and all(name.endswith(_LENGTH) for name in names[len(COLUMNS) :])


def _error_rows(path: Path) -> Rows:
    table, times, _ = read_numbered(TableReader(path))
    rows = [("table", f"{len(table.numbers)} frames at {times.fps:g} a second; lengths in millimetres, no weights")]
    for name in table.names[len(COLUMNS) :]:
        values = torch.from_numpy(table.column(name).copy())
        rows.append((name, f"mean {float(values.nanmean()):.3f}, largest {float(values.nan_to_num(0.0).max()):.3f}"))
    return rows


def _head_model_rows(model: HeadModelFile) -> Rows:
    joints = "none" if model.joints is None else ", ".join(model.joints.names)
    return [
        ("head model", f"{model.name}, licence: {model.licence}"),
        ("identity parameters", str(len(model.identity))),
        ("expression parameters", str(len(model.expressions))),
        ("joints", joints),
        ("places of landmarks", "none" if model.landmarks is None else str(len(model.landmarks.rows))),
        *_mesh_rows(model.neutral),
    ]


def _example_rows(examples: "ExampleShapes") -> Rows:
    from torchface.capture.anybody import ExampleSolver, landmark_observability

    return [
        ("examples", f"{len(examples.names)}: {', '.join(examples.names)}"[:_MAX_LENGTH]),
        ("eyes' distance", f"{examples.eyes_distance:.1f} pixels"),
        ("what landmarks see", str(landmark_observability(ExampleSolver(examples)))),
    ]


def _mesh_rows(mesh: Mesh) -> Rows:
    rows = [
        ("vertices", f"{len(mesh.vertices):,}"),
        ("triangles", f"{len(mesh.faces):,}"),
        ("polygons", "triangles only" if mesh.polygons is None else f"{len(mesh.polygons):,}"),
        ("extent, mm", _extent(mesh.vertices)),
        ("texture coordinates", "none" if mesh.uvs is None else f"{len(mesh.uvs):,}"),
        ("texture", "none" if mesh.texture is None else "x".join(str(n) for n in mesh.texture.shape[:0:-1])),
    ]
    rows += [("warning", fault) for fault in size_faults(mesh)]
    if mesh.annotations is not None:
        notes = mesh.annotations
        rows += [
            ("landmarks", "none" if notes.landmarks is None else str(len(notes.landmarks))),
            ("regions", _named(tuple(notes.regions)) if notes.regions else "none"),
            ("mirror map", "no" if notes.mirror is None else "yes"),
            ("contact pairs", "none" if notes.contacts is None else str(len(notes.contacts))),
        ]
    return rows


def _with_texture_rows(path: Path, rows: Rows) -> Rows:
    unread = unread_textures(path) if path.is_file() and path.suffix.lower() in GLTF_ENDINGS else []
    if not unread:
        return rows
    rows = [("texture", "cannot be read") if row == ("texture", "none") else row for row in rows]
    return [*rows, ("warning", f"{len(unread)} of its textures cannot be read: {unread[0]}")]


def _extent(points: Tensor) -> str:
    """Of finite points (N,3), along x, y and z."""
    return " x ".join(f"{size:.1f}" for size in (points.amax(0) - points.amin(0)).tolist())


def _rig_rows(rig: BlendshapeRig) -> Rows:
    reach = rig.deltas.norm(dim=-1).amax(1)
    reach = reach * (reach > _STILL * (rig.vertices.amax(0) - rig.vertices.amin(0)).max())
    order = reach.argsort(descending=True)[:_MAX_NAMED].tolist()
    largest = ", ".join(f"{rig.names[row]} {float(reach[row]):.1f}" for row in order)
    rows = [*_mesh_rows(rig.neutral), ("shapes", _named(rig.names)), ("largest motions, mm", largest)]
    apart = (rig.deltas - rig.deltas.mean(1, keepdim=True)).norm(dim=-1).amax(1)
    shifts = [f"{rig.names[row]} ({float(reach[row]):.1f} mm)" for row in (apart < _ALIKE * reach).nonzero()[:, 0]]
    if shifts:
        rows.append(
            ("warning", f"all vertices alike in {', '.join(shifts[:_MAX_NAMED])}: the head moves, not the face")
        )
    flat = degenerate_triangles(rig.vertices, rig.neutral.faces)
    lost = {
        name: int((degenerate_triangles(rig.vertices + delta, rig.neutral.faces) & ~flat).sum())
        for name, delta in zip(rig.names, rig.deltas, strict=True)
    }
    counts = {"at rest": int(flat.sum()), **{f"in {name}": count for name, count in lost.items()}}
    if said := [f"{count} {where}" for where, count in counts.items() if count]:
        rows.append(("triangles without area", ", ".join(said[:_MAX_NAMED])))
    moving = {name: bool((reach[list(shape.rows)] > 0).any()) for name, shape in recognised_shapes(rig.names).items()}
    if moving:
        still = [name for name, moves in moving.items() if not moves]
        rows.append(("ARKit's shapes", arkit_count([name for name in moving if moving[name]], still)))
    if rig.correctives is not None:
        between = sum(definition.is_in_between for definition in rig.correctives.definitions)
        rows.append(("correctives", f"{len(rig.correctives.names)}, {between} of them in-betweens"))
    return rows


def _animation_rows(path: Path) -> Rows:
    """What moves a file's shapes, and how far."""
    take = None if path.is_dir() else load_animation(path)
    if take is None or take.weights is None:
        return []
    peaks = take.weights.values[..., 0].amax(0)
    order = peaks.argsort(descending=True)[:_MAX_NAMED].tolist()
    peak = ", ".join(f"{take.weights.names[row]} {float(peaks[row]):.2f}" for row in order if peaks[row] > 0)
    return [
        ("animation", f"{len(take)} frames at {take.rate}, {take.duration:.1f} s"),
        ("largest weights", peak or "none above 0"),
    ]


def _take_rows(take: Take) -> Rows:
    rows = [("frames", f"{len(take)} at {take.rate}, {take.duration:.1f} s")]
    if take.timecode:
        rows.append(("timecode", f"{take.timecode[0]} to {take.timecode[-1]}"))
    for kind in ("markers", "landmarks", "weights"):
        track = getattr(take, kind)
        if track is None:
            continue
        visible = torch.isfinite(track.values).all(-1).float()
        empty = int((visible.sum(1) == 0).sum())
        rows += [
            (kind, _named(track.names)),
            (f"{kind} seen", f"{100 * float(visible.mean()):.2f} %, {empty} frames without any"),
        ]
    if take.markers is not None:
        middles = take.markers.values.nanmedian(0).values
        seen = middles[torch.isfinite(middles).all(1)]
        if len(seen):
            rows.append(("extent, mm", f"{_extent(seen)}, of each marker's median place"))
    if take.weights is not None:
        rows += [("warning", fault) for fault in weight_faults(take.weights)]
    if take.extras:
        columns = take.extras.get("columns")
        named = {"columns": f"columns {', '.join(columns)}"} if isinstance(columns, dict) else {}
        named["unit"] = f"unit {take.extras.get('unit')}"
        rows.append(("kept besides", "; ".join(named.get(name, name) for name in map(str, take.extras))))
    return rows


def _attachment_rows(attachment: Attachment) -> Rows:
    return [
        ("markers", _named(attachment.labels or ()) if attachment.labels else str(len(attachment.triangles))),
        ("made for topology", attachment.fingerprint or "not recorded"),
        ("made for the head", "recorded" if attachment.rest is not None else "not recorded: solve cannot check it"),
    ]


def _graph_rows(path: Path) -> Rows:
    import onnx

    data = read_file(path, 2**28)
    try:
        model = onnx.load_model_from_string(data)
    except Exception as error:  # protobuf raises its own kinds, which are not part of onnx's interface
        raise FileFormatError(f"{path}: not an ONNX file ({error})") from error

    def shape(value: "onnx.ValueInfoProto") -> str:
        return f"{value.name} ({','.join(d.dim_param or str(d.dim_value) for d in value.type.tensor_type.shape.dim)})"

    return [
        ("inputs", ", ".join(map(shape, model.graph.input))),
        ("outputs", ", ".join(map(shape, model.graph.output))),
        ("operators", f"{len(model.graph.node)}: {', '.join(sorted({node.op_type for node in model.graph.node}))}"),
        ("size", f"{len(data):,} bytes"),
        *((entry.key, _shortened(entry.value)) for entry in model.metadata_props),
    ]


def _named(names: Sequence[str]) -> str:
    return f"{len(names)}: {listed(names, 10)}"


def _shortened(text: str) -> str:
    return text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]} ... ({len(text):,} characters)"
