"""``torchface pick``: landmarks, marker sites and correspondences by clicking."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from torchface.cli.command_options import Output
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, serve_page

_FILES = ("landmarks.json", "annotated.glb", "attachment.json", "correspondences.json")


def pick(
    mesh: Positional[Path],
    scan: Positional[Path | None] = None,
    out: Annotated[Path, Output(_FILES)] = Path("picks"),
    mode: Literal["landmarks", "markers", "correspondences"] = "landmarks",
    landmarks: Literal["68", "12"] = "68",
    names: tuple[str, ...] = (),
    unit: str | None = None,
    scan_unit: str | None = None,
    part: str | None = None,
    port: int = 8080,
    quiet: Quiet = False,
) -> None:
    """Pick points on a head by clicking, in the browser: landmark vertices, marker sites, correspondences with a scan.

    Save writes into the folder OUT what has been picked: landmarks.json, annotated.glb (once every landmark is there),
    attachment.json for the markers, correspondences.json for pairs. Started again, it goes on with them. The page is at
    127.0.0.1, no other machine can open it, and none but who knows the whole address that is printed. Needs viser
    (torchface's extra `viewer`).

    Args:
        mesh: A mesh or rig: .glb, USD, .obj, .ply, .stl, .off, a folder of OBJ files, or ICT-FaceKit's FaceXModel
            folder.
        scan: A mesh to find the same places on: click on the head, then on the scan.
        out: The folder to save into. What is not saved at the end is kept in its folder "unsaved".
        mode: What to pick first; the page can change it.
        landmarks: iBUG's 68, or the twelve of eyes, nose, cheeks and mouth.
        names: Names of landmarks of your own instead; "left" and "right" in a name are mirror images.
        unit: Unit of the mesh (um, mm, cm, m, in) where it is not the format's own.
        scan_unit: Unit of the scan.
        part: Keep this region only, such as face.
        port: The first port to try.
    """
    from torchface.files.whole_files import check_writable
    from torchface.io import load_mesh
    from torchface.viz.browser.browser_page import HOST, free_port, import_viser
    from torchface.viz.browser.landmark_sets import IBUG_68, THESIS_12, custom_set
    from torchface.viz.browser.picker import Picker
    from torchface.workflows.posed_mesh import load_neutral, size_faults

    import_viser()
    free_port(HOST, port)
    check_writable(folder=out)
    with progress_bars(quiet) as progress:
        progress("reading")
        head, rig = load_neutral(mesh, unit, part)
        target = None if scan is None else load_mesh(scan, scan_unit)
        wanted = custom_set(names) if names else IBUG_68 if landmarks == "68" else THESIS_12
        progress("opening the page")
        picker = Picker(rig or head, target, out, wanted, mode, mesh.stem, port)
    heads = {f"{mesh} (--unit)": head} | ({} if target is None else {f"{scan} (--scan-unit)": target})
    print_lines(f"warning: {name}: {fault}" for name, shown in heads.items() for fault in size_faults(shown))
    serve_page(picker)
