"""What a game engine gets of an actor's wrinkles: few maps, weights a frame, beside the whole model and the truth.

The performers of ``enhancement_scenes``: 200 database frames of four real takes, two other takes as the test. Maps and
weights are learned from the model on 300 poses of the coarse rig; nothing here has seen the test takes.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from enhancement_comparison import FRAMES, VERTICES, fitted
from enhancement_measures import Errors, Ruler
from enhancement_scenes import Scene, make_scene
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.enhancement.detail.detail_basis import LearnedBasis, StreamingBasis
from torchface.enhancement.detail.detail_encodings import DisplacementDetail
from torchface.enhancement.detail.low_pass import LowPass, vertex_areas
from torchface.enhancement.wrinkle_maps.wrinkle_basis import WrinkleBasis, learn_wrinkle_basis
from torchface.enhancement.wrinkle_maps.wrinkle_teaching import captured_poses, taught_details, teaching_poses
from torchface.enhancement.wrinkle_maps.wrinkle_weights import RigWrinkles, WrinkleWeights
from torchface.onnx import export_wrinkle_weights

pytestmark = [pytest.mark.real, pytest.mark.usefixtures("one_thread")]

MAPS = (2, 4, 8)
POSES, MOST_MS = 300, 2.0


@dataclass(frozen=True, eq=False)
class Engine:
    """A scene, its model, poses of the rig and what the model adds to them."""

    scene: Scene
    model: EnhancementModel
    poses: Tensor
    details: LearnedBasis
    shares: Tensor

    def learned(self, maps: int) -> tuple[WrinkleBasis, WrinkleWeights]:
        """Maps, and what finds their weights."""
        areas = vertex_areas(self.scene.neutral, self.scene.faces).float()
        basis = learn_wrinkle_basis(self.details, self.model.vertex_weights, areas, maps)
        rig = self.scene.performer.rig
        weights = basis.weights(self.details)
        wrinkles = WrinkleWeights.fit(rig.vertices, rig(self.poses), weights, self.shares, self.model.region_names)
        return basis, wrinkles


def best_shown(basis: WrinkleBasis, asked: Tensor) -> Tensor:
    """What the best weights show of details (T,3V)."""
    rows = StreamingBasis(asked.shape[1], len(asked))
    rows.add(asked.clone())
    return basis.details(basis.weights(rows.finished()))


@pytest.fixture(scope="module", params=["performer", "ict"])
def engine(request: pytest.FixtureRequest, data: Path) -> Engine:
    scene = make_scene(request.param, data, VERTICES, FRAMES)
    model = fitted(scene, scene.rigged)
    performer, rig = scene.performer, scene.performer.rig
    captured = captured_poses(model, model.features(performer.smooth(torch.eye(len(rig.names)))))
    shares = model.vertex_weights[:, torch.cdist(rig.vertices, scene.neutral).argmin(1)]
    poses = teaching_poses(captured, shares @ rig.deltas.square().sum(-1).T, POSES)
    details = taught_details(model, lambda begin, end: performer.smooth(poses[begin:end]), len(poses))
    return Engine(scene, model, poses, details, shares)


def test_share_of_detail(engine: Engine) -> None:
    """Of what the smooth input lacks on takes that were not learned."""
    scene, model = engine.scene, engine.model
    low = LowPass(scene.neutral, scene.faces)
    ruler = Ruler(scene.neutral, scene.faces, low)
    known = [ruler.known(true) for true in scene.truth]
    detail = DisplacementDetail(scene.neutral, scene.faces)

    def errors(method: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Errors:
        clips = zip(scene.coarse, scene.test_weights, scene.truth, known, strict=True)
        found = [ruler.errors(method(coarse, weights, true), one) for coarse, weights, true, one in clips]
        return found[0] + found[1]

    smooth = errors(lambda coarse, weights, true: scene.neutral + low(coarse - scene.neutral))
    flicker = torch.stack([one.flicker for one in known]).sum(0)
    database = model.database_features.flatten(1)

    def nearest(coarse: Tensor, weights: Tensor, true: Tensor) -> Tensor:
        rows = torch.cdist(model.features(coarse).flatten(1), database).argmin(1)
        return detail.compose(coarse, detail.encode(scene.rigged[rows], scene.frames[rows]))

    rows: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
        "coarse animation itself": lambda coarse, weights, true: coarse,
        "the whole model": lambda coarse, weights, true: model.enhance(coarse).vertices,
        "nearest frame": nearest,
    }
    for maps in MAPS:
        basis, wrinkles = engine.learned(maps)
        by_rig = RigWrinkles(wrinkles, scene.performer.rig)
        rows[f"{maps} maps, the truth's best weights"] = lambda coarse, weights, true, basis=basis: detail.compose(
            coarse, best_shown(basis, detail.encode(coarse, true))
        )
        rows[f"{maps} maps, weights from the rig's"] = lambda coarse, weights, true, basis=basis, by_rig=by_rig: (
            detail.compose(coarse, basis.details(by_rig(weights)))
        )
    rig = scene.performer.rig
    print(f"\n{scene.name}: {len(scene.neutral):,} vertices, rig of {len(rig.vertices):,}, {POSES} poses learned")
    print(f"{'share of smooth input':38s}{'fine':>8s}{'normals':>9s}{'flicker':>9s}")
    fine = {}
    for name, method in rows.items():
        row = ruler.shares(errors(method), smooth, flicker)
        fine[name] = row.fine
        print(f"{name:38s}{row.fine:8.3f}{row.angle:9.3f}{row.flicker:9.2f}")
    assert fine["4 maps, weights from the rig's"] < fine["nearest frame"]
    assert fine["4 maps, weights from the rig's"] < fine["the whole model"] + 0.03
    if scene.name == "performer":
        assert fine["4 maps, weights from the rig's"] < 0.7 * fine["nearest frame"]
        assert fine["4 maps, the truth's best weights"] < 0.08


def test_milliseconds_a_frame(engine: Engine, tmp_path: Path) -> None:
    """One thread of ONNX Runtime, beside the whole model in PyTorch."""
    rig = engine.scene.performer.rig
    wrinkles = engine.learned(4)[1]
    export_wrinkle_weights(RigWrinkles(wrinkles, rig), engine.poses[:20], tmp_path / "weights.onnx")
    export_wrinkle_weights(wrinkles, rig(engine.poses[:20]), tmp_path / "vertices.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    print(f"\n{'milliseconds a frame':38s}{'median':>8s}{'p95':>8s}")
    for name, values in (("weights", engine.poses[:1]), ("vertices", rig(engine.poses[:1]))):
        session = onnxruntime.InferenceSession(tmp_path / f"{name}.onnx", options, ["CPUExecutionProvider"])
        inputs = {name: values.numpy()}
        taken = []
        for _ in range(300):
            began = time.perf_counter()
            session.run(None, inputs)
            taken.append(1000 * (time.perf_counter() - began))
        median, late = np.median(taken), np.quantile(taken, 0.95)
        print(f"{'map weights of ' + name:38s}{median:8.2f}{late:8.2f}")
        assert median <= MOST_MS
    began = time.perf_counter()
    engine.model.enhance(engine.scene.coarse[0][:8])
    print(f"{'the whole model':38s}{1000 * (time.perf_counter() - began) / 8:8.0f}")
