"""Recordings as phones and other programs write them, built from weights and rotations by each format's description."""

import gzip
import json
import math
import struct
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.io.protocols.ifacialmocap_packets import IFacialMocapPackets
from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.shape_names import ARKIT

TONGUE = (
    *("tongueTipUp", "tongueTipDown", "tongueTipLeft", "tongueTipRight", "tongueRollUp", "tongueRollDown"),
    *("tongueRollLeft", "tongueRollRight", "tongueUp", "tongueDown", "tongueLeft", "tongueRight", "tongueIn"),
    *("tongueStretch", "tongueWide", "tongueNarrow"),
)


def some_frames(count: int = 5) -> tuple[Tensor, Tensor]:
    """Weights (T,52) in hundredths and rotations (T,9), radians; eyes do not roll."""
    generator = torch.Generator().manual_seed(7)
    weights = (torch.rand(count, 52, generator=generator) * 100).round() / 100
    rotations = (torch.rand(count, 9, generator=generator) - 0.5) * torch.tensor([1.0] * 5 + [0.0, 1.0, 1.0, 0.0])
    return weights, rotations


def degrees(rotations: Tensor) -> tuple[list[float], list[float], list[float]]:
    """About ARKit's x, y, z, of head, left and right eye: an eye's yaw is to the right, y turns to the left."""
    yaw, pitch, roll, left_yaw, left_pitch, _, right_yaw, right_pitch, _ = (math.degrees(a) for a in rotations.tolist())
    return [pitch, yaw, roll], [left_pitch, -left_yaw], [right_pitch, -right_yaw]


def face_cap(path: Path, weights: Tensor, rotations: Tensor) -> Path:
    """``info``, ``bs`` and a line ``k`` a frame, 60 a second in milliseconds, names with ``_L`` and ``_R``."""
    sides = {f"{name}Left": f"{name}_L" for name in ("eyeBlink",)}
    lines = ["info,test,iPhone", "bs," + ",".join(sides.get(name, name) for name in ARKIT)]
    for frame, (values, turned) in enumerate(zip(weights, rotations, strict=True)):
        head, left, right = degrees(turned)
        numbers = [round(frame * 1000 / 60), 1.0, 2.0, 3.0, *head, *left, *right, *values.tolist()]
        lines.append("k," + ",".join(f"{number:.6g}" for number in numbers) + ",")
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def ifacialmocap(path: Path, weights: Tensor, rotations: Tensor) -> Path:
    """A frame's text a line."""
    packets = IFacialMocapPackets(ARKIT)
    path.write_bytes(b"".join(packets(w, r)[0] + b"\n" for w, r in zip(weights, rotations, strict=True)))
    return path


def audio2face(path: Path, weights: Tensor, tongue: Tensor) -> Path:
    """52 shapes and 16 of the tongue."""
    document = {
        "exportFps": 30.0,
        "trackPath": "/a.wav",
        "numPoses": 68,
        "numFrames": len(weights),
        "facsNames": [name[0].upper() + name[1:] for name in (*ARKIT, *TONGUE)],
        "weightMat": torch.cat([weights, tongue], 1).tolist(),
    }
    path.write_text(json.dumps(document))
    return path


def columns_of(rotation: Tensor) -> list[float]:
    """A transform's 16 numbers by columns."""
    whole = torch.eye(4, dtype=torch.float64)
    whole[:3, :3] = rotation
    return whole.T.flatten().tolist()


def turned_about_arkits_axes(degrees_xyz: list[float]) -> Tensor:
    """R_y R_x R_z."""
    x, y, z = (math.radians(angle) for angle in (*degrees_xyz, 0.0)[:3])
    rx = torch.tensor([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]], dtype=torch.float64)
    ry = torch.tensor([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]], dtype=torch.float64)
    rz = torch.tensor([[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]], dtype=torch.float64)
    return ry @ rx @ rz


def face_anchors(path: Path, weights: Tensor, rotations: Tensor) -> Path:
    """Frames with blendShapes and transforms."""
    frames: list[dict[str, Any]] = []
    for frame, (values, turned) in enumerate(zip(weights, rotations, strict=True)):
        head, left, right = (columns_of(turned_about_arkits_axes(angles)) for angles in degrees(turned))
        frames.append({
            "timestamp": 100 + frame / 60,
            "blendShapes": dict(zip(ARKIT, values.tolist(), strict=True)),
            "transform": head,
            "leftEyeTransform": left,
            "rightEyeTransform": [right[i : i + 4] for i in range(0, 16, 4)],
        })  # fmt: skip
    path.write_text(json.dumps({"frames": frames}))
    return path


def mediapipe(path: Path, weights: Tensor, javascript: bool = False) -> Path:
    """Results of the Face Landmarker as Python or JavaScript prints them, at 25 a second; no tongue."""
    frames: list[dict[str, Any]] = []
    for frame, values in enumerate(weights):
        scores = [
            ("_neutral", 1e-6),
            *(pair for pair in zip(ARKIT, values.tolist(), strict=True) if pair[0] != "tongueOut"),
        ]
        key = "categoryName" if javascript else "category_name"
        categories = [{"index": i, "score": score, key: name} for i, (name, score) in enumerate(scores)]
        if javascript:
            frames.append({"timestamp": 1000 + 40 * frame, "faceBlendshapes": [{"categories": categories}]})
        else:
            frames.append(
                {"timestamp_ms": 40 * frame, "face_blendshapes": [categories], "face_landmarks": [[{"x": 0.5}]]}
            )
    path.write_text(json.dumps(frames))
    return path


def gesichter(path: Path, weights: Tensor, rotations: Tensor, numbers: list[int] | None = None) -> Path:
    """gzip of version, number of packets, and each with its size before it."""
    packets = LiveLinkPackets(ARKIT, 60.0, "iPhone")
    data = []
    for i, (w, r) in enumerate(zip(weights, rotations, strict=True)):
        packets._sent = i if numbers is None else numbers[i]
        data += packets(w, r)
    whole = struct.pack("!BI", 6, len(data)) + b"".join(struct.pack("!I", len(packet)) + packet for packet in data)
    path.write_bytes(gzip.compress(whole))
    return path
