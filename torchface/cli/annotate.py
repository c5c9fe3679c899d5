"""``torchface annotate``: landmarks of a few frames of an actor, corrected by hand."""

from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_path, serve_page

if TYPE_CHECKING:
    from torch import Tensor

    from torchface.io.video import VideoFile


def annotate(
    video: Positional[Path],
    out: OutputPath,
    landmarks: str = "landmark_network",
    count: int = 15,
    face: int = 0,
    browser: bool = True,
    port: int = 8080,
    quiet: Quiet = False,
) -> None:
    """Correct the landmarks of a few frames of a video by hand, in the browser, for an appearance model to learn from.

    The video is tracked, and frames are proposed that span what the face does in it. On the page every landmark can be
    dragged; Save writes the frame as an image and iBUG's .pts beside it into OUT and turns to the next. Started again,
    it goes on where it was. Then: torchface train appearance --data OUT --out models/NAME. The page is at 127.0.0.1,
    no other machine can open it, and none but who knows the whole address that is printed; it needs viser
    (torchface's extra `viewer`).

    Args:
        video: A video of the actor, extreme faces among what it shows.
        out: The folder for images and .pts files. What is not saved at the end is kept in its folder "unsaved".
        landmarks: What finds landmarks to start from: a model of the zoo by name or folder, an .onnx file, or
            MediaPipe's Face Landmarker (.task); or a .csv that holds those of the whole video.
        count: How many frames.
        face: Which face, from 0, the largest first, where there are several.
        browser: Open the page; --no-browser writes the proposed landmarks at once, to be corrected elsewhere.
        port: The first port to try.
    """
    from torchface.files.content_keys import content_key
    from torchface.files.job_lock import job_lock
    from torchface.workflows.annotate_video import prepare_annotation, write_proposals
    from torchface.workflows.named_finders import load_finder
    from torchface.workflows.track.frame_readings import given_reading
    from torchface.workflows.track.track_models import is_table

    if browser:
        from torchface.viz.browser.browser_page import HOST, free_port, import_viser

        import_viser()
        free_port(HOST, port)
    with job_lock(out):
        with progress_bars(quiet) as progress:

            def track(video: "VideoFile") -> "tuple[Tensor, Tensor | None]":
                from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
                from torchface.landmarks.images.tracking.video_landmarks import track_landmarks

                if finder is None:
                    given = given_reading(Path(landmarks), video)
                    return given.landmarks, given.confidence
                tracker = LandmarkTracker(finder.finder, face=face, fps=video.fps)
                tracked = track_landmarks(video, tracker, progress)
                return tracked.values, tracked.confidence

            progress("reading")
            finder = None if is_table(landmarks) else load_finder(landmarks, "film")
            source = Path(landmarks) if finder is None else finder.source
            key = content_key("annotate/2", landmarks=source, face=face)
            annotation = prepare_annotation(video, out, track, count, key)
        if not browser:
            for path in write_proposals(annotation):
                print_path(path)
            return
        from torchface.viz.browser.annotation_session import AnnotationSession
        from torchface.viz.browser.landmark_editor import LandmarkEditor

        session = AnnotationSession(annotation.frames, annotation.folder, annotation.saved)
        editor = LandmarkEditor(session, video.stem, port)
        serve_page(editor, f"{len(annotation.saved)} of {len(annotation.frames)} frames are saved. ")
