"""``torchface export NAME``: a model of the zoo as ONNX."""

from __future__ import annotations

from rich.table import Table

from torchface.cli.command_options import OutputPath
from torchface.cli.terminal import Quiet, console, print_path, progress_bars


def export_model(name: str, /, out: OutputPath, quiet: Quiet = False) -> None:
    """Write a model of the zoo, or of a folder, as an ONNX file, and check it against PyTorch.

    A head model gives the decoder (coefficients to vertices and colours), an expression regression the offsets of a
    neutral face, UV landmarks the bank of filters, face landmarks the trees (grey image and boxes to 68 points),
    face boxes the network (colour image to boxes and roll angles), a marker solver the solve, a dynamics prior mean and
    deviation of the next frame's weights. Names, units, licence, data and what was measured are in the file's metadata.

    Args:
        name: Of the model, or its folder.
        out: The .onnx file to write.
        quiet: Show no progress.
    """
    from torchface import zoo
    from torchface.files.job_lock import file_lock
    from torchface.onnx import export_model as export

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        progress("loading the model")
        record = zoo.describe(name)
        model = zoo.get_model(name)
        facts = {
            "model": record.name,
            "kind": record.kind,
            "licence": record.licence,
            "data": record.data,
            "metrics": record.metrics,
            "recipe": record.recipe,
            "sha256": record.sha256,
        }
        progress("exporting and checking")
        report = export(model, out, facts)
    table = Table(show_header=False)
    for row in report.rows():
        table.add_row(*row)
    console.print(table)
    print_path(out)
