"""The shipped landmark finders beside MediaPipe on real faces: photographs, clips, and faces spoilt in ten ways.

Who made the landmarks that they are compared with is said in each row: people for five photographs, dlib's own
predictor (rounded to pixels, no truth) for 18 faces, MediaPipe (another network, no truth) for the clips. MediaPipe's
Face Landmarker runs in this process; its networks are newer than those that made the clips' landmarks.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
from real_faces import Outcome, inner_error, outcome

from torchface import zoo
from torchface.errors import MissingExtraError
from torchface.workflows.named_finders import load_finder

TREES, NETWORK, PEER = "face_landmarks", "landmark_network", "face_landmarker.task"


@pytest.fixture(scope="module")
def outcomes(data: Path) -> dict[str, Outcome]:
    """By finder; those that are not installed are left out."""
    found = {}
    for name in (TREES, NETWORK, PEER):
        if name == NETWORK and name not in zoo.list_models():
            continue
        try:
            found[name] = outcome(load_finder(data / "peers" / name if name == PEER else name).finder, data)
        except MissingExtraError as error:
            print(f"\n{name}: no comparison was made: {error}")
    return found


@pytest.mark.real
@pytest.mark.usefixtures("one_thread")
def test_finders_beside_each_other(outcomes: dict[str, Outcome], print_machine: Callable[..., None]) -> None:
    print_machine("onnxruntime", "opencv-contrib-python-headless")
    for name, one in outcomes.items():
        print(f"\n{name}")
        for row, figures in one.rows():
            print(f"  {row:52} {figures}")
    trees = outcomes[TREES]
    assert inner_error(trees.hand) < 0.075
    assert trees.difference() < 0.12
    assert all(counts.total() == 20 for counts in trees.verdicts.values())
    if NETWORK in outcomes:
        network = outcomes[NETWORK]
        assert inner_error(network.hand) < 0.048
        assert network.difference() < 0.05
        assert sum(counts["wrong"] for counts in network.verdicts.values()) <= 6
        if PEER in outcomes:
            assert inner_error(network.hand) < 1.1 * inner_error(outcomes[PEER].hand)
    if PEER in outcomes:  # its older networks made the clips' reference
        assert outcomes[PEER].difference() < 0.05
