"""The exported solver on real takes: one thread, batch 1, cold and warm; its gap to the exact solve.

How long it takes beside other solvers is held in ``test_box_qp_peers.py``.
"""

import time
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.onnx import export_solver
from torchface.onnx.solver_graph_export import hide_markers


def play(session: onnxruntime.InferenceSession, markers: Tensor, warm: bool) -> tuple[Tensor, float, float]:
    """Weights (T,N); median milliseconds a frame, of all and of the quietest 500 frames (others share the machine)."""
    previous = np.zeros((1, session.get_inputs()[1].shape[1]), np.float32)
    solved, times = [], []
    for frame in markers.numpy()[:, None]:
        begin = time.perf_counter()
        (weights,) = session.run(None, {"markers": frame, "previous": previous})
        times.append(time.perf_counter() - begin)
        solved.append(weights)
        previous = weights if warm else previous
    medians = [np.median(times[first : first + 500]) for first in range(0, len(times) - 499, 500)]
    return torch.from_numpy(np.concatenate(solved)).double(), 1000 * float(np.median(times)), 1000 * min(medians)


@pytest.mark.real
@pytest.mark.parametrize(("count", "allowed"), [(100, 1e-5), (50, 5e-5)])
def test_frame_by_frame(
    real_capture: tuple[BlendshapeRig, Attachment, list[Tensor]], tmp_path: Path, count: int, allowed: float
) -> None:
    rig, attachment, takes = real_capture
    layout = attachment.select((attachment.labels or ())[:count])
    path = tmp_path / "solver.onnx"
    print(f"\n{export_solver(rig, layout, path)}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    points = layout.on(rig.neutral.faces, rig(torch.cat(takes)))
    points = points + 0.3 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    exact = MarkerSolver(rig, layout).double()
    print(f"{count} markers, {len(points)} real frames, one thread, batch 1")
    print(f"{'missing':>8} {'start':>6} {'ms/frame':>9} {'quietest':>9} {'worst gap':>10} {'median gap':>11}")
    for missing in (0.0, 0.1, 0.3):
        markers = hide_markers(points, missing) if missing else points
        energy = exact.energy(markers.double())
        least = energy.value(exact(markers.double()))
        for warm in (False, True):
            weights, spent, quiet = play(session, markers, warm)
            gap = (energy.value(weights) - least) / least
            print(f"{missing:8.0%} {'warm' if warm else 'cold':>6} {spent:9.4f} {quiet:9.4f} {float(gap.max()):10.1e} "
                  f"{float(gap.median()):11.1e}")  # fmt: skip
            if not missing:
                assert gap.max() <= allowed
