"""The app in the browser as a folder: page, solver, character and licences."""

import gzip
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError
from torchface.files.job_lock import job_lock
from torchface.files.whole_files import all_or_none, check_writable, delete_file, make_folder, read_file, write_file
from torchface.onnx.runtime_format import in_runtime_format
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app.built_page import built_page
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.webcam.webcam_graph import webcam_graph

CHARACTER, TABLE, GRAPH, PAGE = "character.glb", "character.json", "webcam.graph", "index.html"
_ASSETS, _FORMER_GRAPHS = (".js", ".css", ".wasm"), ("webcam.onnx", "webcam.ort")
_BYTES = 4  # of a number
_TONGUE = ARKIT.index("tongueOut")


@dataclass(frozen=True)
class AppReport:
    """What was written.

    Args:
        sizes: bytes of each file by its path inside the folder.
        packed: the same as gzip has them, which is what a host that compresses sends.
        driven: the character's shapes that a face before the camera, which does not see its tongue, moves.
        still: its other shapes, and those that move nothing.
    """

    sizes: dict[str, int]
    packed: dict[str, int]
    driven: tuple[str, ...]
    still: tuple[str, ...]

    def rows(self) -> list[tuple[str, str]]:
        """Sizes by kind of file, and which shapes move."""
        kinds = {
            "page (HTML, JavaScript, CSS)": (".html", ".js", ".css", ".txt", ".json", ""),
            "ONNX Runtime (WebAssembly)": (".wasm",),
            "solver": (".graph",),
            "character": (".glb",),
        }
        rows = [
            (kind, self._size([name for name in self.sizes if Path(name).suffix in of])) for kind, of in kinds.items()
        ]
        rows.append(("in all", self._size(list(self.sizes))))
        rows.append(("shapes that a face moves", f"{len(self.driven)} of {len(self.driven) + len(self.still)}"))
        return rows

    def _size(self, names: list[str]) -> str:
        plain, packed = (sum(sizes[name] for name in names) / 2**20 for sizes in (self.sizes, self.packed))
        return f"{plain:.2f} MB, {packed:.2f} MB with gzip"


def export_app(
    out: str | Path,
    character: str | Path | None = None,
    webcam: str | Path | None = None,
    progress: Progress | None = None,
    mapping: str | Path | None = None,
) -> AppReport:
    """Writes a folder that any static host serves: a page in which a webcam moves a character, on the user's machine.

    Args:
        out: the folder; files of an earlier app in it are replaced.
        character: a ``.glb`` or ``.vrm``, which is taken as it is, or another rig, with shapes that ARKit knows; the
            embedded performer if absent.
        webcam: the graph from picture to weights, as ``torchface export webcam`` writes it; made, or taken from the
            cache, if absent.
        progress: called with each step.
        mapping: a table (``load_shape_rules``) for shapes of other names than ARKit's.

    Raises:
        FileFormatError: the character or the graph cannot be read, the character is too large, or the folder holds
            something else.
        NameMismatchError: no shape of the character has a name that ARKit knows.
        MissingExtraError: the page has to be built, and Node is missing or failed.
    """
    out, progress = Path(out), progress or silent
    check_writable(folder=out)
    _check_folder(out)
    progress("reading the character")
    shown = load_character(character, None if mapping is None else Path(mapping), progress)
    graph = page_graph(webcam_graph(progress) if webcam is None else read_file(webcam), webcam or "the webcam's graph")
    files = {GRAPH: packed_numbers(graph), CHARACTER: shown.data, TABLE: shown.page_table()}
    page = built_page(progress)
    files |= {path.relative_to(page).as_posix(): read_file(path) for path in sorted(page.rglob("*")) if path.is_file()}
    progress("writing the app")
    with job_lock(out), all_or_none():
        for name, data in files.items():
            make_folder((out / name).parent)
            write_file(out / name, data)
        for old in (out / "assets").iterdir():  # their names change with their content
            if old.suffix in _ASSETS and f"assets/{old.name}" not in files:
                delete_file(old)
        for former in _FORMER_GRAPHS:
            if (out / former).is_file():
                delete_file(out / former)
    packed = {name: len(gzip.compress(data, 6)) for name, data in files.items()}
    sources = zip(shown.names, shown.shapes.matrix, shown.shapes.products, strict=True)
    moved = {
        name
        for name, sums, product in sources
        if _TONGUE not in product and {*sums.nonzero()[:, 0].tolist(), *product} - {_TONGUE}
    }
    driven = tuple(name for name in shown.names if name in moved.difference(shown.still))
    still = tuple(name for name in shown.names if name not in driven)
    return AppReport({name: len(data) for name, data in files.items()}, packed, driven, still)


def packed_numbers(data: bytes) -> bytes:
    """Bytes with gzip, which many hosts do not do for a graph; the first of every four stand before the second.

    So four fifths are left of what gzip makes of numbers of four bytes. The last one is filled up.
    """
    fours = np.frombuffer(data + bytes(-len(data) % _BYTES), np.uint8).reshape(-1, _BYTES)
    return gzip.compress(fours.T.tobytes(), 9, mtime=0)


def _check_folder(out: Path) -> None:
    graph = any((out / name).is_file() for name in (GRAPH, *_FORMER_GRAPHS))
    if out.is_dir() and any(out.iterdir()) and not ((out / PAGE).is_file() and graph):
        raise FileFormatError(f"{out}: found a folder with other files, expected none, an empty one or an earlier app")


_INPUTS = {"image": "tensor(uint8)", "interval": "tensor(float)", "controls": "tensor(float)", "state": "tensor(float)"}
_OUTPUTS = (
    *("weights", "rotation", "translation", "gaze", "landmarks", "iris"),
    *("presence", "calibrated", "next_state"),
)


def page_graph(data: bytes, path: str | Path) -> bytes:
    """The webcam's graph in ONNX Runtime's own format, with its operators joined and its constants computed: the page
    begins with it in a third of the time that the ONNX file takes.
    """
    wanted = f"expected the graph of torchface export webcam ({', '.join(_INPUTS)} to {', '.join(_OUTPUTS)})"
    try:
        saved, session = in_runtime_format(data)
    except Exception as error:  # ONNX Runtime has no common class for what it raises
        raise FileFormatError(f"{path}: not an ONNX file that runs ({str(error)[:160]}), {wanted}") from error
    inputs = {value.name: value.type for value in session.get_inputs()}
    missing = sorted(set(_OUTPUTS) - {value.name for value in session.get_outputs()})
    if inputs != _INPUTS or missing:
        found = ", ".join(f"{name} {kind}" for name, kind in inputs.items())
        raise FileFormatError(f"{path}: found the inputs {found} and no output {', '.join(missing) or '-'}; {wanted}")
    names = session.get_modelmeta().custom_metadata_map.get("names", "[]")
    if tuple(json.loads(names)) != ARKIT:
        raise FileFormatError(f"{path}: found the shapes {names:.80}, expected ARKit's 52 in their order")
    return saved
