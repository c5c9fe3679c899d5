"""Session of ONNX Runtime for graphs of this library's own making."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import onnxruntime


def graph_session(content: bytes) -> "onnxruntime.InferenceSession":
    """A session on one thread of the processor, without log, of an ONNX file's content."""
    import onnxruntime  # programs without graphs do not wait for it

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
