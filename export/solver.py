"""``python -m export.solver --rig RIG --attachment FILE --out solver.onnx``: the marker solve as ONNX."""

import tyro

from torchface.cli.export import solver

if __name__ == "__main__":
    tyro.cli(solver)
