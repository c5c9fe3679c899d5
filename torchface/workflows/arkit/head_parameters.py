"""Expression parameters of head models over time, in and out."""

import io
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import write_file
from torchface.geometry.rotations import rotation_vector
from torchface.geometry.similarity import similarity_transform
from torchface.geometry.skinning import joint_transforms, unskinned
from torchface.io.head_models.array_files import ArrayFile
from torchface.io.head_models.head_model_file import HeadJoints, HeadModelFile
from torchface.number_checks import check_rate
from torchface.rig import BlendshapeRig

EXPRESSIONS = ("exp", "expr", "expression", "expressions", "expcode", "expression_params", "expression_coeffs")
_SHAPES = ("shape", "betas", "identity", "shapecode", "shape_params")
_JAWS = ("jaw", "jaw_pose", "jaw_params", "jawpose")
_EYES = ("eyes", "eyes_pose", "eye_pose", "eye_pose_params")
_POSES = ("pose", "posecode", "pose_params", "full_pose", "fullpose", "rotations")
_RATES = ("fps", "frame_rate", "mocap_framerate")
_MOST_FRAMES = 2**20
_RIDGE = 1e-3  # mm² a vertex for a squared parameter of 1
_CHUNK = 2**22
_FOLLOWS = 0.5


@dataclass(frozen=True, eq=False)
class HeadParameters:
    """What moves a head model."""

    expressions: Tensor  # (T,e)
    rotations: Tensor | None = None  # of its joints, axis times angle, (T,J,3); None without joints
    person: Tensor | None = None  # identity parameters, (k,); None for the mean head
    fps: float | None = None  # frames a second, where the file says so
    unread: tuple[str, ...] = ()  # arrays that were left out

    def __len__(self) -> int:
        return len(self.expressions)


def has_parameters(arrays: ArrayFile) -> bool:
    """Whether a file of arrays holds expression parameters."""
    return arrays.first(EXPRESSIONS) is not None


def read_parameters(arrays: ArrayFile, model: HeadModelFile) -> HeadParameters:
    """Parameters as EMOCA, SMIRK, DECA and others write them; the head's own rotation and translation are left out.

    Args:
        arrays: ``exp`` (T,E), and ``jaw`` (T,3) or ``pose`` (T,6), the head's rotation before the jaw's, or all joints'
            (T,3J), ``eyes`` (T,6), ``shape`` (K,) or (T,K), of which the mean counts; or other spellings of these.
    """
    key = arrays.first(EXPRESSIONS)
    if key is None:
        raise arrays.error(EXPRESSIONS[0], "expression parameters (T,E)")
    values = _table(arrays, key)
    if not 0 < values.shape[1] <= len(model.expressions) or not 0 < len(values) <= _MOST_FRAMES:
        raise arrays.error(key, f"1 to {_MOST_FRAMES} frames of at most {len(model.expressions)} parameters")
    used, person = {key}, None
    if (key := arrays.first(_SHAPES)) is not None:
        used.add(key)
        person = _table(arrays, key).mean(0)
        person = person[: len(model.identity)]
    rotations = _rotations(arrays, model.joints, len(values), used)
    unread = tuple(name for name in arrays.names if name not in used and name not in _RATES)
    return HeadParameters(values, rotations, person, stated_rate(arrays), unread)


def stated_rate(arrays: ArrayFile) -> float | None:
    """Frames a second, where a file of arrays says so."""
    key = arrays.first(_RATES)
    if key is None:
        return None
    values = arrays.numbers(key, *arrays.shape(key)).flatten()
    if not len(values):
        raise arrays.error(key, "frames a second")
    return check_rate(float(values[0]), f"{arrays.path}: {key}")


def _table(arrays: ArrayFile, key: str) -> Tensor:
    """An array as rows: (N,) is one, (T,1,N) is (T,N)."""
    shape = arrays.shape(key)
    if not 0 < len(shape) <= 4:
        raise arrays.error(key, "rows of numbers")
    values = arrays.numbers(key, *shape)
    return values[None] if len(shape) == 1 else values.flatten(1)


def _rotations(arrays: ArrayFile, joints: HeadJoints | None, count: int, used: set[str]) -> Tensor | None:
    if joints is None:
        return None
    size = len(joints.names)
    rotations = torch.zeros(count, size, 3)
    jaw, eyes = joints.index("jaw"), [joints.index(f"{side}_eye") for side in ("left", "right")]
    for keys in (_POSES, _JAWS, _EYES):
        key = arrays.first(keys)
        if key is None:
            continue
        used.add(key)
        values = _table(arrays, key)
        width = values.shape[1]
        if len(values) != count:
            raise arrays.error(key, f"{count} frames, as of the expression parameters")
        if keys is _POSES and width == 3 * size:
            inner = values.unflatten(1, (size, 3))
            for row in (jaw, *eyes):
                if row is not None:
                    rotations[:, row] = inner[:, row]
        elif keys is _POSES and width in (3, 6):
            if width == 6 and jaw is not None:
                rotations[:, jaw] = values[:, 3:]
        elif keys is _JAWS and width == 3 and jaw is not None:
            rotations[:, jaw] = values
        elif keys is _EYES and width == 6 and None not in eyes:
            rotations[:, eyes] = values.unflatten(1, (2, 3))  # type: ignore[index]
        else:
            raise arrays.error(key, f"rotation vectors of joints that the model has: {', '.join(joints.names)}")
    return rotations


def parameters_of(model: HeadModelFile, rig: BlendshapeRig, weights: Tensor) -> tuple[HeadParameters, Tensor]:
    r"""The model's parameters that come nearest to ARKit weights.

    Rotations of jaw and eyes add up from each shape's own; then the joints are taken out and

    .. math:: \min_e \frac{1}{V} \lVert E e - u \rVert^2 + \rho \lVert e \rVert^2

    Args:
        model: with joints or without.
        rig: its mean head with ARKit's shapes.
        weights: by the rig's names, (T,N).

    A model whose expressions move the jaw themselves is nearer without the joints: then their rotations are 0.

    Returns:
        The parameters, and the root mean square distance that is left, (T,), millimetres.
    """
    plain = _parameters(replace(model, joints=None), rig, weights)
    if model.joints is None:
        return plain
    turned = _parameters(model, rig, weights)
    if float(turned[1].mean()) < float(plain[1].mean()):
        return turned
    still = torch.zeros(len(weights), len(model.joints.names), 3)
    return replace(plain[0], rotations=still), plain[1]


def _parameters(model: HeadModelFile, rig: BlendshapeRig, weights: Tensor) -> tuple[HeadParameters, Tensor]:
    count, rest = len(rig.vertices), model.neutral.vertices.double()
    basis = model.expressions.double().flatten(1)
    joints, turns = model.joints, None
    if joints is not None:
        turns = _shape_rotations(joints, rig)
    gram = (basis @ basis.T) / count + _RIDGE * torch.eye(len(basis), dtype=torch.float64)
    factor = torch.linalg.cholesky(gram)
    codes, left, rotations = [], [], []
    step = max(1, _CHUNK // (3 * count))
    for some in weights.double().split(step):  # a chunk of frames bounds the memory
        goal = rest + torch.tensordot(some, rig.deltas.double(), 1)
        own = goal
        if joints is not None and turns is not None:
            turned = torch.einsum("tn,njc->tjc", some, turns)
            where = joint_transforms(joints.of(rest).double(), joints.parents, turned)
            own = unskinned(goal, joints.weights, *where) - model.pose_correctives(turned).double()
            rotations.append(turned.float())
        offset = (own - rest).flatten(1)
        code = torch.cholesky_solve((offset @ basis.T).T / count, factor).T
        codes.append(code.float())
        left.append(((offset - code @ basis).square().sum(1) / count).sqrt())
    return HeadParameters(torch.cat(codes), torch.cat(rotations) if rotations else None), torch.cat(left)


def _shape_rotations(joints: HeadJoints, rig: BlendshapeRig) -> Tensor:
    """How each shape turns jaw and eyes, axis times angle, (N,J,3): as the vertices that follow them most."""
    turns = torch.zeros(len(rig.names), len(joints.names), 3, dtype=torch.float64)
    for name, begins in (("jaw", "jaw"), ("left_eye", "eyeLook"), ("right_eye", "eyeLook")):
        row = joints.index(name)
        if row is None:
            continue
        ids = (joints.weights[:, row] > max(_FOLLOWS, 0.9 * float(joints.weights[:, row].max()))).nonzero()[:, 0]
        if len(ids) < 3:
            continue
        rest = rig.vertices.double()[ids]
        posed = rest + rig.deltas.double()[:, ids]
        found = rotation_vector(similarity_transform(rest.expand_as(posed), posed, scale=False).rotation)
        own = torch.tensor([bool(re.match(begins, shape)) for shape in rig.names])
        turns[:, row] = torch.where(own[:, None], found, 0.0)
    return turns


def save_parameters(parameters: HeadParameters, joints: HeadJoints | None, fps: float, path: Path) -> None:
    """Writes ``.npz``: ``exp``, ``fps``, of models with joints ``jaw`` and ``eyes``, as FLAME's readers take them."""
    arrays = {"exp": parameters.expressions.numpy(), "fps": np.array(fps, np.float32)}
    if joints is not None and parameters.rotations is not None:
        arrays["pose"] = parameters.rotations.flatten(1).numpy()
        jaw = joints.index("jaw")
        if jaw is not None:
            arrays["jaw"] = parameters.rotations[:, jaw].numpy()
        eyes = [joints.index(f"{side}_eye") for side in ("left", "right")]
        if None not in eyes:
            arrays["eyes"] = parameters.rotations[:, eyes].flatten(1).numpy()  # type: ignore[index]
    if path.suffix.lower() != ".npz":
        raise FileFormatError(f"{path}: found the ending {path.suffix!r}, expected .npz")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_file(path, buffer.getvalue())
