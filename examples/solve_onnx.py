"""Solve marker frames with an exported solver: onnxruntime and numpy, nothing else.

Usage: python solve_onnx.py solver.onnx markers.npy weights.npy   (markers: (T,M,3), millimetres, NaN for not seen)
"""

import json
import sys

import numpy as np
import onnxruntime

if len(sys.argv) != 4 or not sys.argv[3].endswith(".npy"):  # which numpy.save would append
    sys.exit(__doc__)
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
names = json.loads(session.get_modelmeta().custom_metadata_map["shape_names"])
markers = np.load(sys.argv[2]).astype(np.float32)
previous, solved = np.zeros((1, len(names)), np.float32), []
for frame in markers:
    (previous,) = session.run(["weights"], {"markers": frame[None], "previous": previous})
    solved.append(previous[0])
np.save(sys.argv[3], np.array(solved))
print(f"{len(markers)} frames, {len(names)} weights each ({names[0]}, {names[1]}, ...): {sys.argv[3]}")
