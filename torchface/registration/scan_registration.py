"""A template bent onto a raw scan: the scan's face in the template's topology."""

import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError
from torchface.geometry.meshes.operators import edges, vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex, SurfacePoints
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.number_checks import checked_type
from torchface.progress import Progress, silent
from torchface.registration.hair_and_cloth import Cover
from torchface.registration.model_fit import HasShape, ModelFit, ShapeModel, fit_to_scan, shape_model
from torchface.registration.nonrigid.correspondence import exposed_vertices
from torchface.registration.nonrigid.deformer import Deformer
from torchface.registration.nonrigid.lip_contact import contact_pull
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.registration.nonrigid.schedule import DEFAULT_SCHEDULE, Schedule
from torchface.registration.nonrigid.unfolding import grown
from torchface.registration.scan_colors import (
    ScanColors,
    has_colors,
    in_shade,
    resampled_texture,
    shown_share,
    skin_base,
    vertex_colors,
    with_edge_of_hair,
)
from torchface.registration.scan_completion import completed_colors, completed_form
from torchface.registration.scan_preparation import (
    Landmarks,
    check_template,
    lost_part_notes,
    one_side_notes,
    prepare_scan,
)
from torchface.registration.scan_start import Detector, StartOnScan, scale_notes, start_on_scan

_NEAR = 3.0
_FAR = 10.0
_SETTLED = 12.0  # reach of a stage, millimetres: from there on the template lies close to the scan
_MAX_COMPLETIONS = 6
_MIN_MET = 0.1  # share of what faces outward; scans of faces alone under templates of whole heads give a quarter

FALSE_COLORS = "the scan's colours are not a face's"
"""How the note begins on colours by which neither hair nor cloth is looked for."""
NO_COLORS = (
    "the scan has neither a texture with coordinates nor vertex colours (is the image that its material names beside "
    "it?); the result has no colours"
)
"""A note, untrue of a scan whose colours the user leaves out."""


@dataclass(frozen=True, eq=False)
class Registration:
    """A template registered to a scan.

    Args:
        mesh: the scan's face in the template's topology, in the scan's place, with the scan's colours.
        pose: the similarity that first aligned the template with the scan, a batch of one.
        distance: of each vertex to the scan, (V,) float64, millimetres; beyond 10 mm it may be a little too long.
        matched: which vertices' positions the scan shows, (V,) bool; the others follow their neighbours.
        record: what was done.
        coefficients: of the model that the registration started from, (K,), where one was given.
        landmarks: those that held it, given or found: vertices (L,) and the scan's points (L,3) float64.
    """

    mesh: Mesh
    pose: Similarity
    distance: Tensor
    matched: Tensor
    record: RegistrationRecord
    coefficients: Tensor | None = None
    landmarks: Landmarks | None = None


def register(
    template: Mesh,
    scan: Mesh,
    landmarks: Landmarks | None = None,
    *,
    detector: Detector | None = None,
    model: ShapeModel | HasShape | None = None,
    schedule: Schedule | None = None,
    texture_size: int = 1024,
    progress: Progress | None = None,
) -> Registration:
    r"""The scan's face in the template's topology, by non-rigid iterated closest points.

    .. math:: E(X) = \lVert \alpha (M \otimes G) X \rVert^2 + \lVert W (D X - U) \rVert^2
        + \lVert \beta (D_L X - U_L) \rVert^2

    A similarity lays the template on the scan, by landmarks where there are any, else by its shape alone, in any
    pose. Rigid iterated closest points settle it. Then the template bends: for stiffness :math:`\alpha` falling in
    steps, correspondences and the best affine maps X are found in turn until the vertices rest. All in float64 on
    the CPU; the same input gives the same result.

    Args:
        template: a face, millimetres. Only what faces outward looks for the scan; parts that share no vertex with it
            (eyeballs, teeth) follow the rest.
        scan: millimetres; any topology and pose, with holes, hair, collar, crumbs, either side out.
        landmarks: template vertex ids (L,) int64 and scan points (L,3); at least three, NaN rows are skipped. Those of
            the jaw's contour (of a template with 68) let go where surface and other landmarks contradict them.
        detector: asked for landmarks where none are given, once the template lies on the scan.
        model: of faces in the template's topology (a ``MorphableModel`` or ``HeadModel``). It is fitted to the scan
            first and the template bends from there: what the model knows no longer slides along the surface. The
            schedule's first stage, which does the same roughly, is left out.
        schedule: which steps, see ``Schedule``; ``DEFAULT_SCHEDULE`` if absent.
        texture_size: texels a side of the texture that is made where the scan has colours and the template
            texture coordinates; 0 makes none.
        progress: called with each step and how far it is.

    Returns:
        ``Registration(mesh, pose, distance (V,), matched (V,), record)``.

    Raises:
        ShapeError: landmarks of the wrong shape, or fewer than three that can be used.
        TopologyError: an empty or tiny mesh, a landmark on no vertex of the template, or a model of another topology.
        ValueRangeError: another unit than millimetres, landmarks on a line, or a scan that does not show the face.
        AlignmentError: the landmarks do not fit, no pose is found without them, or hardly anything of the template
            comes to lie on the scan.

    Source: Amberg, Romdhani, Vetter 2007; thesis 3.2.3, equation 7 and Algorithm 1.

    Example:
        >>> from torchface.synthetic import draw_identities, neutral_head
        >>> template = neutral_head(texture=False)
        >>> somebody = neutral_head(draw_identities(1, torch.Generator().manual_seed(0))[0], texture=False)
        >>> marks = (template.landmarks, somebody.vertices[somebody.landmarks])
        >>> registered = register(template, somebody, marks, schedule=Schedule(DEFAULT_SCHEDULE.stages[:1]))
        >>> bool(registered.distance.median() < 1)  # millimetres
        True
    """
    checked_type("template", template, Mesh)
    checked_type("scan", scan, Mesh)
    begin, progress = time.perf_counter(), progress or silent
    if texture_size < 0 or texture_size > 16384:
        raise ShapeError(f"texture_size: found {texture_size}, expected 0 to 16384")
    check_template(template)
    shape = None if model is None else shape_model(model, template)
    progress("checking the head")
    prepared = prepare_scan(scan, template)
    progress("placing the template on the head")
    schedule = schedule or DEFAULT_SCHEDULE
    start = start_on_scan(template, scan, prepared, landmarks, detector, schedule)
    aligned = start.pose.apply(template.vertices.detach().cpu().double())[0]
    contacts = contact_pull(aligned, template)
    fit, stages_left = None, schedule.stages
    if shape is not None:
        progress("fitting the model")
        fit = _model_fit(shape, template, aligned, start, schedule)
        aligned, stages_left = fit.vertices, schedule.stages[1:] or schedule.stages
    deformer = Deformer(aligned, template.faces.cpu(), start.surface, start.pull, contacts, schedule)
    surface = start.prepared
    colors = ScanColors(scan, surface.vertices, surface.faces, surface.face_ids) if has_colors(scan) else None
    cover = Cover(template, deformer.exposed, start.surface, colors)
    start_distance = float(start.surface.among_nearest_samples(deformer.current[deformer.exposed]).distance.median())
    stages = []
    for number, stage in enumerate(stages_left, 1):
        progress("bending the template", number - 1, len(stages_left))
        deformer.hidden = cover.hidden(deformer.current, settled=stage.reach <= _SETTLED)
        stages.append(deformer.run(stage, number))
    deformer.unfold()
    progress("measuring")
    nearest = _nearest(start.surface, deformer.current)
    matched = cover.without_islands(_matched(deformer, start.surface, nearest, schedule))
    met = float(matched[deformer.exposed].double().mean())
    if met < _MIN_MET:
        raise AlignmentError(
            f"scan: found only {met:.0%} of the bent template's surface on the scan, expected at least "
            f"{_MIN_MET:.0%}; do the landmarks belong to this scan, and does it show what the template shows?"
        )
    unseen = ~cover.features & ~matched
    if unseen.any():
        progress("completing missing parts")
        nearest, unseen = _completed(deformer, template, start.surface, nearest, unseen, cover)
        matched &= ~unseen
    mesh = replace(template, vertices=deformer.current.to(template.vertices), colors=None, texture=None)
    notes = [*start.notes, *scale_notes(start.pose), *start.pull.disagreement(deformer.current)]
    if fit is not None:
        near, far = f"{fit.noise:.2f} mm (robust deviation)", float(fit.coefficients.abs().max())
        notes.append(f"the model comes to {near} of the scan, {far:.1f} standard deviations off")
    notes += [*_final_notes(template, scan, deformer, texture_size), *one_side_notes(template, matched)]
    notes += lost_part_notes(template, deformer.outward, matched | deformer.hidden)
    if cover.false_colors:
        notes.append(
            f"{FALSE_COLORS} ({cover.false_colors}, in logarithms): no hair or cloth was looked "
            "for by them; --no-colors leaves them out of the result too"
        )
    if colors is not None:
        progress("resampling the colours")
        mesh = _colored(mesh, template, colors, nearest, matched, unseen, texture_size)
    record = RegistrationRecord(
        start.by,
        start_distance,
        tuple(stages),
        tuple(notes),
        float(nearest.distance[matched].median()) if matched.any() else float("nan"),
        float(matched.double().mean()),
        time.perf_counter() - begin,
        float(nearest.distance[matched].quantile(0.95)) if matched.any() else float("nan"),
        float(matched[deformer.outward].double().mean()),
        float((deformer.hidden & ~matched)[deformer.outward].double().mean()),
        _stretch(template, deformer.current, matched),
        start.pull.slid(deformer.current),
    )
    device = template.vertices.device
    coefficients = None if fit is None else fit.coefficients.to(template.vertices)
    distance, held = nearest.distance.to(device), (start.pull.vertices, start.pull.points)
    return Registration(mesh, start.pose, distance, matched.to(device), record, coefficients, held)


def _model_fit(model: ShapeModel, template: Mesh, aligned: Tensor, start: StartOnScan, schedule: Schedule) -> ModelFit:
    faces = template.faces.cpu()
    exposed = exposed_vertices(aligned, faces, schedule.opening).nonzero()[:, 0]
    landmarks = (start.pull.vertices, start.pull.points)
    return fit_to_scan(model, faces, aligned, exposed, start.surface, landmarks, schedule.largest_angle)


def _nearest(surface: SurfaceIndex, points: Tensor) -> SurfacePoints:
    """Exact where the scan is near; what has no place on it would take many times as long as all the rest."""
    quick = surface.among_nearest_samples(points)
    near = quick.distance <= _FAR
    exact = surface.nearest(points[near])
    for found, better in ((quick.points, exact.points), (quick.barycentric, exact.barycentric)):
        found[near] = better
    quick.triangle[near], quick.distance[near] = exact.triangle, exact.distance
    return quick


def _matched(deformer: Deformer, surface: SurfaceIndex, nearest: SurfacePoints, schedule: Schedule) -> Tensor:
    own = vertex_normals(deformer.current, deformer.faces)
    cosine = torch.cos(torch.deg2rad(torch.tensor(schedule.largest_angle, dtype=torch.float64)))
    alike = (own * surface.normals_at(nearest)).sum(-1) >= cosine
    return deformer.outward & ~deformer.hidden & alike & ~surface.on_border(nearest) & (nearest.distance <= _NEAR)


def _final_notes(template: Mesh, scan: Mesh, deformer: Deformer, texture_size: int) -> list[str]:
    notes = []
    folded = int(deformer.folded_triangles().sum())
    if folded:
        turned = "1 triangle of the result is" if folded == 1 else f"{folded} triangles of the result are"
        notes.append(
            f"{turned} turned over, as at holes, lids, lips and ears; correct landmarks "
            "there, or smooth them in a mesh editor"
        )
    if not has_colors(scan):
        notes += [
            NO_COLORS,
            "without colours hair cannot be distinguished from skin: where the scan has hair, the skull may have the "
            "hair's shape",
        ]
    elif template.uvs is None and texture_size:
        notes.append("the template has no texture coordinates; the scan's colours are on the vertices only")
    return notes


def _completed(
    deformer: Deformer, template: Mesh, surface: SurfaceIndex, nearest: SurfacePoints, unseen: Tensor, cover: Cover
) -> tuple[SurfacePoints, Tensor]:
    """Lays the unseen vertices where the template has them; the places on the scan and what is unseen then.

    Where that turns triangles over, as between skin and an ear under hair, what lies around them is unseen too, and
    of an ear all.
    """
    before, rest, faces = deformer.current, template.vertices.detach().cpu().double(), deformer.faces
    doubtful = cover.beside(deformer.hidden)
    for _ in range(_MAX_COMPLETIONS):
        shown = deformer.outward & ~unseen
        laid, unseen = completed_form(rest, before, faces, unseen, shown, doubtful)
        deformer.lay(laid)
        folded = faces[deformer.folded_triangles()].flatten()
        around = torch.zeros_like(unseen)
        around[folded[~cover.features[folded]]] = True
        around = grown(around, faces) & ~cover.features
        if not around.any():
            break
        unseen = torch.stack([unseen, around, *(ear for ear in cover.ears if (ear & around).any())]).any(0)
    deformer.unfold()
    moved = ((deformer.current - before).square().sum(-1) > 0).nonzero()[:, 0]
    newer = _nearest(surface, deformer.current[moved])
    completed = SurfacePoints(*(part.clone() for part in vars(nearest).values()))
    completed.points[moved], completed.triangle[moved] = newer.points, newer.triangle
    completed.barycentric[moved], completed.distance[moved] = newer.barycentric, newer.distance
    return completed, unseen


def _stretch(template: Mesh, current: Tensor, matched: Tensor) -> float:
    """The 95th percentile of how much an edge between matched vertices has grown or shrunk beyond the whole."""
    first, second = edges(template.faces.cpu()).T
    seen = matched[first] & matched[second]
    if not seen.any():
        return float("nan")
    before, after = (x[first[seen]] - x[second[seen]] for x in (template.vertices.detach().cpu().double(), current))
    ratio = (after.norm(dim=-1) / before.norm(dim=-1).clamp(min=1e-9)).clamp(min=1e-9).log()
    return float((ratio - ratio.median()).abs().quantile(0.95).expm1())


def _colored(
    mesh: Mesh, template: Mesh, source: ScanColors, nearest: SurfacePoints, matched: Tensor, unseen: Tensor, size: int
) -> Mesh:
    colors = vertex_colors(source, nearest, matched)
    place, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    shown = shown_share(
        place, with_edge_of_hair(unseen, source.at(nearest.triangle, nearest.barycentric), matched, faces)
    )
    # The last skin before hair is in its shadow: the fill starts where the scan's colours count in full.
    filled = completed_colors(colors, skin_base(colors, template, matched), place, faces, shown < 1)
    colors = torch.lerp(filled, colors, shown[:, None])
    filled, colors = (in_shade(one, mesh, matched) for one in (filled, colors))
    texture = resampled_texture(mesh, template, filled, shown, source, size) if size and mesh.uvs is not None else None
    device = mesh.vertices.device
    return replace(mesh, colors=colors.to(device), texture=None if texture is None else texture.to(device))
