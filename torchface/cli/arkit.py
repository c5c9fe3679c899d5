"""``torchface arkit``: ARKit's shapes on any head, and its animations as ARKit weights."""

from pathlib import Path

from tyro.conf import Positional

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path


def arkit(
    source: Positional[Path],
    out: OutputPath,
    animation: Path | None = None,
    weights: Path | None = None,
    template: Path | None = None,
    landmarks: Path | None = None,
    everything: bool = False,
    temporal: bool = True,
    fps: float | None = None,
    unit: str | None = None,
    quiet: Quiet = False,
) -> None:
    """Give any head ARKit's 52 shapes on its own vertices, or turn its animations into ARKit weights and back.

    SOURCE is a head model as its authors publish it (GNM Head's gnm_head.npz, FLAME's arrays as .npz or .safetensors,
    Basel's .h5, MHR's lodN.npz, eos's .bin), a rig with other shapes, or a mesh. A template is registered to it; its
    shapes go over to the vertices of the head, whose number and order stay. Eyeballs turn, teeth go with the jaw.
    Shapes that SOURCE has under ARKit's names, or names that mean the same, are kept.

    With --animation, its parameters or meshes become ARKit weights: each frame's vertices are solved for weights from 0
    to 1, all of them at once, without the head's own motion. The error is written beside, in millimetres a frame, and
    the lines say what ARKit's shapes cannot show. With --weights, ARKit weights become the model's parameters.

    Args:
        source: The head model, rig or mesh.
        out: The rig to write (.glb, USD, .ma, or a folder's name); with --animation the weights (.csv); with --weights
            the parameters (.npz).
        animation: Expression parameters of the model (.npz or .safetensors: exp, jaw or pose, shape; as EMOCA, SMIRK
            and others write them), or meshes of SOURCE's topology: a folder of .obj or .ply, a frame each, a mesh
            sequence (.safetensors), an array of vertices (.npz), face anchors with their vertices (.json), a
            point cache in USD, as of Audio2Face, or an animated .glb.
        weights: ARKit weights (.csv, .json, .txt, .gesichter).
        template: The rig whose shapes are given; the embedded performer if absent. ICT-FaceKit's FaceXModel has shapes
            of scanned people.
        landmarks: SOURCE's landmarks (.ljson, .pts, .json, or correspondences of `torchface pick`) where it has none
            and its shape alone is not found.
        everything: Make all 52, also those that SOURCE has.
        temporal: Solve all frames of an animation together, smooth in time; --no-temporal solves each by itself.
        fps: Frames a second of an animation; as its file says, or 30, if absent. Of weights by name where their file
            has neither times nor a rate.
        unit: Unit of SOURCE's file (um, mm, cm, m, in) where it is not the format's own.
    """
    from torchface.errors import ValueRangeError
    from torchface.files.job_lock import file_lock
    from torchface.workflows.arkit.arkit_job import AnimationSettings, animation_to_weights, arkit_head, weights_back

    if animation is not None and weights is not None:
        raise ValueRangeError(f"found --animation {animation} and --weights {weights}, expected one of them")
    with file_lock(out), progress_bars(quiet) as progress:
        if weights is not None:
            lines = weights_back(source, weights, out, template, landmarks, progress)
        elif animation is not None:
            settings = AnimationSettings(template, landmarks, everything, temporal, fps, unit)
            lines = animation_to_weights(source, animation, out, settings, progress)
        else:
            lines = arkit_head(source, out, template, landmarks, everything, unit, progress)
    print_lines(lines)
    print_path(out)
