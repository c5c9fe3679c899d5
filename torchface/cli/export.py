"""``torchface export``: ONNX graphs for applications without PyTorch."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from torchface.cli.progress import console, steps


def solver(rig: Path, attachment: Path, out: Path, part: str | None = None, quiet: bool = False) -> None:
    """Write the marker solve of one rig and one marker layout as an ONNX file, and check it.

    Inputs of the graph: `markers` (B,M,3), millimetres, NaN where not seen, and `previous` (B,N), the weights of the
    frame before (zeros will do). Output: `weights` (B,N). Shape names, marker labels and units are in the file's
    metadata. ONNX Runtime is compared with PyTorch, and the graph with the exact solve at 0, 10 and 30 % missing
    markers.

    Args:
        rig: A .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        attachment: Where the markers sit, as JSON.
        out: The .onnx file to write.
        part: Keep this region of the rig only, such as face.
        quiet: Show no progress.
    """
    from torchface.attachment import Attachment
    from torchface.io import load_rig
    from torchface.onnx import export_solver

    with steps(quiet) as step:
        step("reading the rig")
        loaded, where = load_rig(rig, part=part), Attachment.load(attachment)
        step("exporting and checking")
        report = export_solver(loaded, where, out)
    table = Table(show_header=False)
    for row in report.rows():
        table.add_row(*row)
    console.print(table)
    print(out)


EXPORTS = {"solver": solver}
