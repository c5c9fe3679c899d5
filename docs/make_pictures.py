"""Makes the README's pictures of the embedded performer: ``PYTHONPATH=.:tests python docs/make_pictures.py``
after ``make demo``."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from matplotlib.figure import Figure

from planted.face_paint import face_paint
from planted.light_stage import LightStageSettings, render_lit_video
from torchface.capture.own_rig.lighting import estimate_light
from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.geometry.cameras.pinhole import look_at
from torchface.io import load_image, load_rig, save_image
from torchface.io.video import open_video
from torchface.mesh import Mesh
from torchface.registration import register
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, from_figure, from_pillow, save_rendered_image, sheet
from torchface.rendering.point_light import PointLight, vertex_albedo
from torchface.rendering.texture_overlay import FacePaint, overlay, relight
from torchface.synthetic import IDENTITY, Character, Look, character, draw_identities, performer
from torchface.synthetic.head.embedded_character import shown_rig
from torchface.synthetic.stages.scanner import eyes_closed, scan_head
from torchface.synthetic.stages.weight_curves import perform
from torchface.synthetic.stages.wrinkles import WrinkledPerformer
from torchface.viz.figures.face_views import FRONT, PROFILE, THREE_QUARTER, face_views
from torchface.viz.figures.registration_views import registration_sheet
from torchface.workflows.fit.photograph_rig import fit_photographs

HERE = Path(__file__).resolve().parent
SIZE = {"width": 232, "height": 290}
PEOPLE = (
    ({"jaw_width": -1.4, "brow_ridge": -1.6, "neck_width": -1.8, "upper_lip": 1.2, "lower_lip": 1.0, "nose_width": -0.8,
      "face_height": -1.2, "brow_height": 0.8, "eye_opening": 0.8},
     Look(age=25.0, hair=(0.33, 0.19, 0.10), lips=1.2, haircut="long", shirt=(0.42, 0.20, 0.22))),
    ({"jaw_width": 1.2, "chin_protrusion": 1.0, "nose_width": 1.6, "lip_fullness": 1.5, "upper_lip": 1.5,
      "lower_lip": 1.3}, Look(melanin=0.8, age=35.0, hair=(0.05, 0.045, 0.04), iris=(0.16, 0.10, 0.06), freckles=0.0)),
    ({"cheek_fullness": 1.0, "ear_size": 1.5, "nose_length": 1.2, "upper_lip": -1.2, "nose_tip_size": 1.0},
     Look(age=72.0, hair=(0.62, 0.61, 0.60), iris=(0.30, 0.40, 0.47))),
    ({"jaw_width": -1.6, "brow_ridge": -1.4, "neck_width": -1.8, "nose_width": 1.0, "upper_lip": 1.6, "lower_lip": 1.6,
      "face_height": -1.0, "eye_opening": 0.6},
     Look(melanin=0.5, age=45.0, hair=(0.07, 0.05, 0.045), iris=(0.2, 0.12, 0.07), haircut="long",
          shirt=(0.26, 0.33, 0.28))),
    ({"nose_bridge": -1.2, "face_width": 1.0, "cheekbones": 1.0, "eye_slant": 0.8, "face_height": -0.8},
     Look(melanin=0.12, age=28.0, hair=(0.04, 0.035, 0.035), iris=(0.16, 0.10, 0.06), freckles=0.3)),
    ({"jaw_width": -1.2, "brow_ridge": -1.5, "neck_width": -1.6, "nose_length": 0.8, "upper_lip": -0.8,
      "ear_size": 1.0}, Look(age=68.0, hair=(0.72, 0.70, 0.68), iris=(0.33, 0.42, 0.36), haircut="tied",
                              shirt=(0.30, 0.24, 0.34))),
)  # fmt: skip
"""Offsets of ``IDENTITY`` in standard deviations, and looks: three women and three men."""


def performer_sheet() -> torch.Tensor:
    """The character from three sides, frames of a performance over its curves, six other people."""
    shown = character()

    def view(one: Character, yaw: float, width: int, weights: torch.Tensor | None = None) -> torch.Tensor:
        rig = one.rig
        posed = rig.neutral if weights is None else rig.neutral.with_vertices(rig(weights[None])[0])
        camera = look_at(torch.tensor([0.0, -14.0, 0.0]), yaw, span=300.0, width=width, height=width * 9 // 8)
        return render(posed, camera, samples=3, normal_map=one.surface.neutral)

    sides = [view(shown, yaw, 396) for yaw in (FRONT, THREE_QUARTER, PROFILE)]
    take = perform(420, torch.Generator().manual_seed(66))
    assert take.weights is not None
    weights = shown.rig.weights_from(take.weights)
    frames = list(range(12, 420, 47))
    strip = [view(shown, 15.0, 129, weights[frame]) for frame in frames]
    order = [parameter.name for parameter in IDENTITY]
    people = []
    for offsets, look in PEOPLE:
        identity = torch.zeros(len(order))
        for name, value in offsets.items():
            identity[order.index(name)] = value
        people.append(view(character(performer(identity, texture=False), look, size=1024), 22.0, 196))
    rows = [sheet(sides, 3), sheet(strip, 9), _curves(weights, shown.rig.names, frames, take.fps), sheet(people, 6)]
    return sheet(rows, 1)


def _curves(weights: torch.Tensor, names: tuple[str, ...], frames: list[int], fps: float) -> torch.Tensor:
    """The most active shapes over time, with the frames that are shown marked."""
    figure = Figure(figsize=(11.96, 1.5), dpi=100)
    axes = figure.add_axes((0.004, 0.05, 0.992, 0.92))
    lively = [row for row in weights.std(0).argsort(descending=True).tolist() if not names[row].endswith("Right")]
    for row in lively[:8]:
        axes.plot(torch.arange(len(weights)) / fps, weights[:, row], label=names[row], linewidth=1.6)
    for frame in frames:
        axes.axvline(frame / fps, color="0.75", linewidth=0.8, zorder=0)
    half = (frames[1] - frames[0]) / 2
    axes.set(xlim=((frames[0] - half) / fps, (frames[-1] + half) / fps), ylim=(-0.02, 1.02), xticks=[], yticks=[])
    axes.legend(loc="upper right", fontsize=7, ncols=4, framealpha=0.85)
    for side in axes.spines.values():
        side.set_visible(False)
    return from_figure(figure)


def registration_picture() -> torch.Tensor:
    """Another head's raw scan, the performer bent onto it, and how far off it is."""
    identity = draw_identities(1, torch.Generator().manual_seed(11))[0]
    scan = scan_head(eyes_closed(performer(identity)), seed=50)
    template = eyes_closed(performer())
    found = register(template, scan.mesh, (template.landmarks, scan.ibug), texture_size=2048)
    return registration_sheet(scan.mesh, found, maximum=0.5)


def fit_picture() -> torch.Tensor:
    """Three photographs of another head, the head fitted to them, and its rig in views no photograph shows."""
    actor = shown_rig(performer(draw_identities(1, torch.Generator().manual_seed(21))[0], texture=False))
    weights = torch.zeros(1, len(actor.names))
    weights[0, actor.index(["mouthSmileLeft", "mouthSmileRight"])] = 0.7
    smiling = actor.neutral.with_vertices(actor(weights)[0])
    ids = smiling.landmarks
    marks, cells = [], []
    with tempfile.TemporaryDirectory() as folder:
        photographs = [Path(folder) / f"{yaw:+.0f}.png" for yaw in (-35.0, 0.0, 35.0)]
        for path in photographs:
            camera = look_at(smiling.vertices[ids].mean(0), float(path.stem), span=300.0, width=464, height=580)
            save_image(render(smiling, camera, background=(0.35, 0.4, 0.45)), path)
            marks.append(camera.project(smiling.vertices[ids].double()))
            points = path.with_suffix(".pts")
            rows = "\n".join(f"{x:.3f} {y:.3f}" for x, y in (marks[-1] + 1).tolist())
            points.write_text(f"version: 1\nn_points: {len(ids)}\n{{\n{rows}\n}}\n")
            cells.append(caption(_half(load_image(path)), "rendered photograph"))
        files = [path.with_suffix(".pts") for path in photographs]
        fit_photographs(photographs, files, "head", Path(folder) / "rig.glb")
        rig = load_rig(Path(folder) / "rig.glb")
    jaw = torch.zeros(1, len(rig.names))
    jaw[0, rig.names.index("jawOpen")] = 0.7
    for title, yaw, mesh in (
        ("rig at rest", -20.0, rig.neutral),
        ("rig at rest", 70.0, rig.neutral),
        ("rig, jawOpen", 20.0, rig.neutral.with_vertices(rig(jaw)[0])),
    ):
        cells.append(caption(face_views(mesh, (yaw,), framed_by=rig.neutral, **SIZE), title))
    return sheet(cells, 6)


def relight_picture() -> torch.Tensor:
    """A frame of a video, the same with mirrored light, and with face paint in the frame's light."""
    rig = shown_rig(performer(draw_identities(1, torch.Generator().manual_seed(5))[0], texture=False))
    weights = torch.zeros(1, len(rig.names))
    weights[0, rig.index(["mouthSmileLeft", "mouthSmileRight", "cheekSquintLeft", "cheekSquintRight"])] = 0.55
    planted = PointLight(
        torch.tensor([0.3, 0.31, 0.34]), torch.tensor([0.8, 0.72, 0.62]), torch.tensor([-420.0, -120, 420])
    )
    stage = LightStageSettings(width=600, height=360, samples=3, noise=0.006, span=300.0)
    with tempfile.TemporaryDirectory() as folder:
        film = render_lit_video(
            Path(folder) / "film.avi", rig, weights, planted, 12.0, torch.Generator().manual_seed(2), stage
        )
        frame = next(iter(open_video(film.video.path).color_frames()))
    vertices, camera, mesh = film.vertices[0], film.cameras[0], rig.neutral
    light = estimate_light(frame, vertices, mesh.faces, vertex_albedo(mesh), camera).light
    other = PointLight(light.ambient, light.intensity.flip(0), torch.tensor([480.0, -260, 250]))
    relit = relight(frame, mesh.with_vertices(vertices), light, other, camera)
    painted = overlay(frame, vertices, FacePaint.of(mesh, face_paint()), light, camera)
    titles = ("film", "relit", "painted, in the film's light")
    middle = round(float(camera.project(vertices.double())[:, 0].mean()))
    cut = slice(middle - 120, middle + 120)
    pictures = [
        caption(one[:, :, cut].float() / 255, title) for one, title in zip((frame, relit, painted), titles, strict=True)
    ]
    return sheet(pictures, 3)


def enhancement_picture() -> torch.Tensor:
    """A frame of two expressions together that were captured one by one: coarse, enhanced, and the truth."""
    actor, head = WrinkledPerformer(vertices=60_000), shown_rig(performer(texture=False))
    brows = ["browInnerUp", "browOuterUpLeft", "browOuterUpRight"]
    smile = [f"{shape}{side}" for shape in ("mouthSmile", "cheekSquint", "eyeSquint") for side in ("Left", "Right")]
    sneer = [f"{shape}{side}" for shape in ("browDown", "noseSneer") for side in ("Left", "Right")]
    extremes = torch.zeros(3, len(actor.names))
    for row, shapes in enumerate((brows, smile, sneer)):
        extremes[row, actor.rig.index(shapes)] = 1.0
    there_and_back = torch.cat([torch.linspace(0, 1, 8), torch.ones(4), torch.linspace(1, 0, 8)])[:, None]
    weights = torch.cat([there_and_back * extreme for extreme in extremes])
    captured = CapturedPerformance(
        actor.frames(weights, 24.0),
        actor.neutral.faces,
        torch.arange(3).repeat_interleave(len(there_and_back)),
        actor.neutral.vertices,
        coarse=actor.smooth(weights),
        landmarks=actor.neutral.landmarks,
    )
    take = there_and_back[:12] * (0.9 * extremes[0] + 0.7 * extremes[1])
    coarse, truth = actor.smooth(take), actor.frames(take, 24.0)
    enhanced = EnhancementModel.fit(captured, EnhancementSettings(fps=24.0))(coarse)
    pose = torch.zeros(1, len(head.names))
    pose[0, head.index(actor.names)] = take[-1]
    inside = sum(head.neutral.annotations.regions[name] for name in ("eyeball_left", "eyeball_right", "mouth_interior"))
    parts = head.neutral.faces[inside[head.neutral.faces].all(1)]  # the actor is skin alone
    colors = torch.cat([torch.tensor([[0.72, 0.56, 0.47]]).expand(len(truth[0]), 3), vertex_albedo(head.neutral)])
    faces = torch.cat([actor.neutral.faces, parts + len(truth[0])])
    camera = look_at(torch.tensor([10.0, -12.0, 70.0]), 16.0, span=205.0, width=300, height=380)
    pictures = [
        caption(render(Mesh(torch.cat([frames[-1], head(pose)[0]]), faces), camera, colors, samples=3), title)
        for title, frames in (("coarse animation", coarse), ("enhanced", enhanced), ("truth", truth))
    ]
    return sheet(pictures, 3)


def _half(image: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(image[None, :3], 2)[0]


def main() -> None:
    from PIL import Image

    save_rendered_image(performer_sheet(), HERE / "images" / "performer.jpg")
    save_rendered_image(registration_picture(), HERE / "images" / "registration.jpg")
    save_rendered_image(fit_picture(), HERE / "images" / "fit.jpg")
    save_rendered_image(relight_picture(), HERE / "images" / "relight.jpg")
    save_rendered_image(enhancement_picture(), HERE / "images" / "enhancement.jpg")
    with Image.open(HERE.parent / "out" / "demo" / "frame_1.png") as image:
        save_rendered_image(from_pillow(image), HERE / "images" / "demo.jpg")


if __name__ == "__main__":
    main()
