"""``torchface view``: a rig in the browser."""

from pathlib import Path

from tyro.conf import Positional

from torchface.cli.command_options import OptionalOutputPath, Part
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, serve_page


def view(
    rig: Positional[Path],
    weights: Positional[Path | None] = None,
    out: OptionalOutputPath = None,
    part: Part = None,
    port: int = 8080,
    quiet: Quiet = False,
) -> None:
    """Show a rig in the browser: a slider a shape, symmetric editing, playback of a take, detail maps,
    saving edited weights.

    The page is at 127.0.0.1, no other machine can open it, and none but who knows the whole address that is printed.
    Needs viser (torchface's extra `viewer`).

    Args:
        rig: A .glb or USD file, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        weights: A weight take to play and edit, such as a Live Link Face CSV or an animated .glb, also the rig's own.
        out: Where Save writes the weights: a .csv; if absent edited_weights.csv here, or beside the take.
            What is not saved at the end is kept beside it, as NAME_unsaved.csv.
        port: The first port to try.
    """
    from torchface.files.whole_files import check_ending, check_writable
    from torchface.io import load_detail_maps, load_rig
    from torchface.io.rig_files import SCENE_ENDINGS
    from torchface.viz.browser.browser_page import HOST, free_port, import_viser
    from torchface.viz.browser.rig_viewer import RigViewer
    from torchface.workflows.posed_mesh import size_faults
    from torchface.workflows.weight_files import filled, load_weight_take, without_shape

    import_viser()  # what is missing should be said before a large rig is read
    free_port(HOST, port)
    if out is None:
        out = Path("edited_weights.csv") if weights is None else weights.with_name(f"{weights.stem}_edited.csv")
    check_ending(out, ".csv")
    check_writable(out)
    with progress_bars(quiet) as progress:
        progress("reading the rig")
        loaded = load_rig(rig, part=part)
        detail = load_detail_maps(rig) if rig.suffix.lower() in SCENE_ENDINGS else None
        take, empty, faults = None, 0, [f"warning: {rig}: {fault}" for fault in size_faults(loaded.neutral)]
        if weights is not None:
            progress("reading the take")
            take, empty = filled(load_weight_take(weights))
            faults += [f"warning: {rig} {lost} {weights}" for lost in without_shape(loaded, take.weights)]
        progress("opening the page")
        viewer = RigViewer(loaded, take, out, detail, rig.stem, port)
    print_lines(faults)
    gaps = f"{empty} frames without a face take what lies between their neighbours, saved too. " if empty else ""
    serve_page(viewer, gaps)
