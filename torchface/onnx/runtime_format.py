"""Models in ONNX Runtime's own format, with which it begins in a fifth of the time."""

from pathlib import Path
from tempfile import TemporaryDirectory

import onnxruntime

from torchface.files.whole_files import read_file


def in_runtime_format(model: bytes) -> tuple[bytes, onnxruntime.InferenceSession]:
    """An ONNX model with its operators joined and its constants computed, for any processor, and a session of it.

    The file is for the version of ONNX Runtime that wrote it and for later ones. What ONNX Runtime raises of a model
    that does not run, it raises here.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 1  # errors alone
    # What goes further is for this machine's processor alone.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    options.add_session_config_entry("session.save_model_format", "ORT")
    with TemporaryDirectory() as folder:
        options.optimized_model_filepath = str(Path(folder) / "model.ort")
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        return read_file(Path(folder) / "model.ort"), session
