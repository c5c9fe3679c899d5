"""Versions that all ONNX graphs are written in."""

OPSET = 18  # of the operators: the oldest that the exporter of PyTorch writes
IR_VERSION = 8  # of the file's format, the oldest that runtimes of the last years read
