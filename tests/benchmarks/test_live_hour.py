"""An hour before a webcam: memory while frames are solved, sent and recorded, and while the files are made."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from planted_faces import Endless, ShadeSolver

from torchface.io import load_take
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.live.live_session import LiveSession, Notes
from torchface.workflows.live.recordings import Recordings
from torchface.workflows.live.weight_streams import WeightStreams

_HOUR = 3600 * 30


def megabytes() -> float:
    """Memory of this process that lies in no file, such as the log that frames are read from."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1024
    raise AssertionError("the system does not tell")


def test_an_hour_takes_no_more_memory_than_a_minute(tmp_path: Path) -> None:
    sizes: dict[int, float] = {}

    class Weighed(Endless):
        def frames(self) -> Iterator[tuple[float, np.ndarray]]:
            for number, frame in enumerate(super().frames()):
                if number % 1800 == 0:
                    sizes[number] = megabytes()
                yield frame

    recordings = Recordings(tmp_path / "out", load_character(), "planted", 30.0)
    with WeightStreams(("osc://127.0.0.1:9",), ARKIT, 30.0, lambda note: None) as streams:
        session = LiveSession(Weighed(_HOUR), ShadeSolver(), streams, recordings, Notes(print), print)
        session.record(True)
        began = time.process_time()
        session.run()
        took = time.process_time() - began
    peak, done = [0.0], threading.Event()

    def watch() -> None:
        while not done.wait(0.05):
            peak[0] = max(peak[0], megabytes())

    watcher = threading.Thread(target=watch)
    watcher.start()
    before, began = megabytes(), time.process_time()
    (take,) = recordings.finish()
    done.set()
    watcher.join()
    growth = max(sizes.values()) - sizes[1800]
    print(
        f"\n{_HOUR:,} frames: {growth:.1f} MB more after an hour than after a minute, {1000 * took / _HOUR:.2f} ms each"
    )
    print(
        f"files: {time.process_time() - began:.0f} s, {peak[0] - before:.0f} MB at most; error: {take.error or 'none'}"
    )
    for path in sorted(take.folder.iterdir()):
        print(f"{path.name}: {path.stat().st_size / 2**20:.0f} MB")
    assert growth < 8
    assert peak[0] - before < 250
    assert len(load_take(take.folder / "weights.csv")) == _HOUR
