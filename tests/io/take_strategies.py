"""Takes by chance, round trips and broken files for the tests of every take format."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from torchface.errors import FileFormatError
from torchface.take import Take, Track

FLOATS = st.floats(-1e6, 1e6, width=32)
RATES = st.sampled_from([24.0, 25.0, 24000 / 1001, 30000 / 1001, 30.0, 60000 / 1001, 60.0, 120.0, 59.9, 240.0, 12.5])
"""Usual rates and some that are not."""

NAMES = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0\t\r\n"), min_size=1, max_size=12
).filter(lambda name: name == name.strip())


@st.composite
def marker_takes(draw: st.DrawFn) -> Take:
    """Markers with gaps; one marker is seen in one frame at least."""
    labels = draw(st.lists(NAMES, min_size=1, max_size=5, unique=True))
    frames = draw(st.integers(2, 6))
    values = draw(arrays.arrays(np.float32, (frames, len(labels), 3), elements=FLOATS))
    seen = draw(arrays.arrays(bool, (frames, len(labels))))
    seen[draw(st.integers(0, frames - 1)), draw(st.integers(0, len(labels) - 1))] = True
    values[~values.any(2), 2] = 1.0  # the origin stands for not seen
    values[~seen] = np.nan
    return Take(draw(RATES), markers=Track(tuple(labels), torch.from_numpy(values)))


@st.composite
def weight_takes(draw: st.DrawFn, names: tuple[str, ...] | None = None) -> Take:
    """Weights of shapes with odd names, or of these."""
    if names is None:
        names = tuple(draw(st.lists(NAMES, min_size=1, max_size=5, unique=True)))
    frames = draw(st.integers(2, 6))
    number = st.floats(-2, 2, width=32) | st.just(float("nan"))
    values = draw(arrays.arrays(np.float32, (frames, len(names), 1), elements=number))
    return Take(draw(RATES), weights=Track(names, torch.from_numpy(values)))


def same(first: torch.Tensor, second: torch.Tensor) -> bool:
    """Bit by bit the same numbers, NaN where the other has NaN."""
    return first.dtype == second.dtype and np.array_equal(first.numpy(), second.numpy(), equal_nan=True)


def round_trip(save: Callable[[Take, Path], None], load: Callable[[Path], Take], take: Take) -> Take:
    """The take as it comes back from a file; names and values are the same to the bit."""
    with tempfile.TemporaryDirectory() as folder:
        save(take, Path(folder, "take"))
        back = load(Path(folder, "take"))
    for track, found in ((take.markers, back.markers), (take.weights, back.weights)):
        assert (track is None) == (found is None)
        if track is not None and found is not None:
            assert found.names == track.names
            assert same(found.values, track.values)
    return back


def check_refused(load: Callable[[Path], Take], path: Path, good: str, change: tuple[str, str], message: str) -> None:
    """A good file with one change is refused, by its name and with this message."""
    assert change[0] in good
    path.write_text(good.replace(*change, 1))
    with pytest.raises(FileFormatError, match=rf"{path.name}: " + message):
        load(path)
