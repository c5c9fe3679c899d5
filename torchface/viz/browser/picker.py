"""The picking page: a click on the head, or on the scan beside it, becomes a landmark, a marker or a pair."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import TopologyError, TorchfaceError, ValueRangeError
from torchface.files.whole_files import all_or_none, made_folder, unused
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io import save_correspondences, save_landmarks, save_mesh, save_rig
from torchface.mesh import Annotations, Mesh
from torchface.rig import BlendshapeRig
from torchface.viz.browser.browser_page import SCALE, BrowserPage, frame_camera, icon
from torchface.viz.browser.head_mesh import HeadOnPage
from torchface.viz.browser.html_lists import caption, pick_list
from torchface.viz.browser.landmark_sets import IBUG_68, LandmarkSet
from torchface.viz.browser.pick_session import Picks, PickSession, SurfacePoint

if TYPE_CHECKING:
    import viser

MODES = ("landmarks", "markers", "correspondences")
_NEXT = "next"
_COLORS = {"landmarks": (232, 84, 60), "markers": (46, 134, 193), "pairs": (39, 155, 96), "waiting": (245, 190, 40)}
_GAP = 1.15
_DOT = 0.012


class Picker(BrowserPage):
    """Landmark vertices, marker sites and scan correspondences by clicking.

    Args:
        scan: shown to the right of it, for pairs.
        landmark_set: names and order of the landmarks.
        mode: what the first click picks: one of ``MODES``.
    """

    def __init__(
        self,
        mesh: Mesh | BlendshapeRig,
        scan: Mesh | None = None,
        out: str | Path = "picks",
        landmark_set: LandmarkSet = IBUG_68,
        mode: str = "landmarks",
        label: str = "torchface pick",
        port: int = 8080,
    ) -> None:
        self.rig = mesh if isinstance(mesh, BlendshapeRig) else None
        neutral = mesh.neutral if isinstance(mesh, BlendshapeRig) else mesh
        self.session = PickSession(neutral, scan, landmark_set)
        self.out = Path(out)
        vertices = self.session.mesh.vertices
        self._normals = vertex_normals(vertices, self.session.mesh.faces).double()
        self._dot = _DOT * float(vertices.amax(0)[1] - vertices.amin(0)[1])
        try:
            self.session.resume(self.out)
        except TopologyError as error:
            raise TopologyError(f"{self.out}: {error}, or give another --out") from None
        self._saved = self.session.picks
        modes = MODES if scan is not None else MODES[:2]
        if mode not in modes:
            raise ValueRangeError(f"mode: found {mode!r}, expected {' or '.join(modes)}; pairs need a scan")
        super().__init__(label, port)
        self.head = HeadOnPage(self.server, self.session.mesh, "head")
        self.scan_offset = torch.zeros(3, dtype=torch.float64)
        if self.session.scan is not None:
            self.scan_offset = _beside(self.session.mesh.vertices, self.session.scan.vertices)
            self.scan_head = HeadOnPage(self.server, self.session.scan, "scan", tuple(self.scan_offset.tolist()))
        frame_camera(self.server, self.session.mesh, 1.0 if scan is None else 1.0 + _GAP)
        self._add_panel(mode, modes)
        self._dots: dict[str, viser.PointCloudHandle] = {}
        self._refresh("Click on the head.")
        self.server.scene.on_click()(self._clicked)

    def click(self, origin: Tensor, direction: Tensor) -> str:
        """Picks what a ray, millimetres, meets in the page's scene; returns what it did, in words."""
        with self._lock:
            point, on_scan = self._nearest(origin, direction)
            message = "Nothing there." if point is None else self._pick(point, on_scan)
            self._refresh(message)
            return message

    def undo(self) -> None:
        """Takes the last pick back."""
        with self._lock:
            self._refresh("Taken back." if self.session.undo() else "Nothing to take back.")

    def save(self) -> list[Path]:
        """Writes what is picked into the folder."""
        with self._lock:
            written = save_picks(self.session, self.out, self.rig)
            self._saved = self.session.picks
            return written

    def keep_unsaved(self) -> list[Path]:
        """Writes picks since the last save into the folder's ``unsaved``, which a new start can be given."""
        picks = replace(self.session.picks, waiting=None)
        if picks in (replace(self._saved, waiting=None), Picks((None,) * len(picks.landmarks))):
            return []
        return save_picks(self.session, unused(self.out / "unsaved"), self.rig)

    def _nearest(self, origin: Tensor, direction: Tensor) -> tuple[SurfacePoint | None, bool]:
        """The first surface in the ray's way, and whether it is the scan's."""
        on_head = self.session.on_mesh(origin, direction)
        beyond = self.session.on_scan(origin - self.scan_offset, direction)
        if on_head is None or beyond is None:
            return (beyond, True) if on_head is None else (on_head, False)
        eye = origin.double()
        near = (torch.tensor(on_head.position, dtype=torch.float64) - eye).norm()
        far = (torch.tensor(beyond.position, dtype=torch.float64) + self.scan_offset - eye).norm()
        return (on_head, False) if near <= far else (beyond, True)

    def _pick(self, point: SurfacePoint, on_scan: bool) -> str:
        session, mode, mirrored = self.session, self._mode.value, self._mirrored.value
        if mode == "correspondences":
            if on_scan:
                return f"{session.pick_scan(point)}: complete."
            session.pick_template(point)
            return f"Vertex {point.vertex}; now click the same place on the scan."
        if on_scan:
            return f"{mode.capitalize()} go on the head, not on the scan."
        if mode == "markers":
            labels = session.pick_marker(point, self._marker_label.value.strip() or None, mirrored)
            self._marker_label.value = ""
            return f"{' and '.join(labels)}: triangle {point.triangle}."
        chosen = self._landmark.value
        names = session.landmark_set.names
        row = session.pick_landmark(point, mirrored, None if chosen == _NEXT else names.index(chosen))
        self._landmark.value = _NEXT
        return f"{names[row]}: vertex {point.vertex}."

    def _add_panel(self, mode: str, modes: tuple[str, ...]) -> None:
        gui = self.server.gui
        with gui.add_folder("Pick"):
            self._mode: Any = gui.add_dropdown("Mode", modes, initial_value=mode)
            self._landmark: Any = gui.add_dropdown("Landmark", (_NEXT, *self.session.landmark_set.names))
            self._marker_label: Any = gui.add_text("Marker label", "", hint="Empty: marker000 and on")
            self._mirrored = gui.add_checkbox("Mirrored", False, hint="Picks the other side too")
            self._message = gui.add_html("")
            undo = gui.add_button("Undo", icon=icon("ARROW_BACK_UP"))
            self._add_save_button("Save picks", f"Writes to {self.out}", lambda: ", ".join(map(str, self.save())))
        with gui.add_folder("Picked"):
            self._list = gui.add_html("")
        self._mode.on_update(lambda _: self._mode_changed())
        undo.on_click(lambda _: self.undo())
        self._mode_changed()

    def _mode_changed(self) -> None:
        mode = self._mode.value
        self._landmark.visible = mode == "landmarks"
        self._marker_label.visible = mode == "markers"
        self._mirrored.visible = mode != "correspondences"

    def _clicked(self, event: "viser.SceneClickEvent") -> None:
        origin = torch.tensor(event.ray_origin, dtype=torch.float64) / SCALE
        try:
            self.click(origin, torch.tensor(event.ray_direction, dtype=torch.float64))
        except TorchfaceError as error:
            self._refresh(str(error))

    def _refresh(self, message: str) -> None:
        picks, session = self.session.picks, self.session
        missing = session.next_landmark
        ahead = "" if missing is None or self._mode.value != "landmarks" else session.landmark_set.names[missing]
        landmarks = [vertex for vertex in picks.landmarks if vertex is not None]
        pairs = [vertex for _, vertex, _ in picks.pairs]
        waiting = [] if picks.waiting is None else [picks.waiting]
        on_scan = [torch.tensor(point, dtype=torch.float64) + self.scan_offset for _, _, point in picks.pairs]
        with self.server.atomic():
            self._message.content = caption(message) + (caption(f"Next: {ahead}") if ahead else "")
            counts = {"landmarks": f"{len(landmarks)} of {len(picks.landmarks)}"}
            counts |= {"markers": str(len(picks.markers)), "pairs": str(len(pairs))}
            last = [
                *(name for name, _ in picks.markers[-6:]),
                *(f"{name}: vertex {v}" for name, v, _ in picks.pairs[-6:]),
            ]
            self._list.content = pick_list(list(counts.items()), last)
            self._draw("landmarks", self._raised(landmarks))
            markers = [torch.tensor(p.position) - session.mesh.vertices[p.vertex] for _, p in picks.markers]
            feet = self._raised([p.vertex for _, p in picks.markers])
            self._draw("markers", [foot + step for foot, step in zip(feet, markers, strict=True)])
            self._draw("pairs", [*self._raised(pairs), *on_scan])
            self._draw("waiting", self._raised(waiting))

    def _raised(self, vertices: list[int]) -> list[Tensor]:
        """Places of vertices lifted above the surface, so that a flat dot does not sink into it."""
        lifted = self.session.mesh.vertices.double() + 0.4 * self._dot * self._normals
        return list(lifted[vertices])

    def _draw(self, kind: str, points: list[Tensor]) -> None:
        """Round dots at the points (millimetres); a cloud of another size is a new node, viser has no empty one."""
        old = self._dots.pop(kind, None)
        if old is not None:
            old.remove()
        if points:
            places = (torch.stack(points) * SCALE).numpy().astype(np.float32)
            self._dots[kind] = self.server.scene.add_point_cloud(
                f"/picks/{kind}",
                places,
                _COLORS[kind],
                point_size=self._dot * SCALE,
                point_shape="circle",
                precision="float32",
            )


def _beside(template: Tensor, scan: Tensor) -> Tensor:
    """What moves the scan to the template's right, at its height and depth, (3,) float64."""
    middle = [(points.amin(0) + points.amax(0)).double() / 2 for points in (template, scan)]
    width = torch.maximum(template.amax(0) - template.amin(0), scan.amax(0) - scan.amin(0))[0]
    offset = middle[0] - middle[1]
    offset[0] += _GAP * float(width)
    return offset


def save_picks(session: PickSession, folder: str | Path, rig: BlendshapeRig | None = None) -> list[Path]:
    """Writes everything that is picked, and says into which files.

    ==================== =======================================================================================
    landmarks.json       landmark vertices, :func:`torchface.io.landmarks.picks.load_landmarks`
    annotated.glb        the mesh, or ``rig``, with the landmarks as annotations; once all of the set are picked
    attachment.json      marker sites, ``Attachment.load``
    correspondences.json pairs of template and scan, :func:`torchface.io.landmarks.picks.load_correspondences`
    ==================== =======================================================================================
    """
    folder, picks = Path(folder), session.picks
    picked = [vertex for vertex in picks.landmarks if vertex is not None]
    if not (picked or picks.markers or picks.pairs):
        raise ValueRangeError("picks: found none, expected a landmark, a marker or a correspondence to save")
    files: dict[str, Callable[[Path], object]] = {}
    if picked:
        files["landmarks.json"] = partial(save_landmarks, session.landmarks())
    if len(picked) == len(picks.landmarks):
        notes = replace(session.mesh.annotations or Annotations(), landmarks=torch.tensor(picked, dtype=torch.int64))
        mesh = replace(session.mesh, annotations=notes)
        whole = None if rig is None else BlendshapeRig(mesh, rig.deltas.cpu(), rig.names, rig.correctives)
        files["annotated.glb"] = partial(save_mesh, mesh) if whole is None else partial(save_rig, whole)
    if picks.markers:
        files["attachment.json"] = session.attachment().save
    if picks.pairs:
        files["correspondences.json"] = partial(save_correspondences, session.correspondences())
    with made_folder(folder), all_or_none():
        for name, write in files.items():
            write(folder / name)
    return [folder / name for name in files]
