"""Labels as recorders write them are found among an attachment's."""

import pytest

from torchface.capture.markers import match_labels, own_labels
from torchface.errors import NameMismatchError

KNOWN = ("M001", "M002", "brow_L")


@pytest.mark.parametrize(
    ("found", "labels", "unmatched"),
    [
        (("M002", "M001"), ("M002", "M001"), ()),
        (("Actor:M001", "Actor:M002", "Actor:helmet", "*12"), ("M001", "M002"), ("Actor:helmet", "*12")),
        (("m001", "BROW_l", "Actor:m002"), ("M001", "brow_L", "M002"), ()),
        (("Stage:Actor:brow_L", "take_M001"), ("brow_L", "M001"), ()),
        # What is there as it is wins over what only resembles it.
        (("Other:M001", "M001", "m001"), ("M001",), ("Other:M001", "m001")),
    ],
)
def test_prefixes_and_case_do_not_matter(
    found: tuple[str, ...], labels: tuple[str, ...], unmatched: tuple[str, ...]
) -> None:
    match = match_labels(found, KNOWN)
    assert match.labels == labels
    assert match.unmatched == unmatched
    assert match.channels == tuple(name for name in found if name not in unmatched)


def test_an_attachment_with_a_subjects_prefix_serves_another_subject() -> None:
    match = match_labels(["Jane:M001", "M002"], ["Joe:M001", "Joe:M002"])
    assert match.labels == ("Joe:M001", "Joe:M002")


def test_a_map_goes_first_and_leaves_out() -> None:
    match = match_labels(["face1", "M001", "Actor:M002"], KNOWN, {"face1": "M001", "Actor:M002": ""})
    assert (match.channels, match.labels) == (("face1",), ("M001",))
    assert match.unmatched == ("M001", "Actor:M002")


def test_a_map_may_leave_a_subjects_prefix_out() -> None:
    found = ("Jane:M001", "Jane:LSHO", "Jane:brow", "Tom:brow")
    assert match_labels(found, KNOWN, {"LSHO": "M002"}).labels == ("M001", "M002")
    assert own_labels(found, {"LSHO": ""}).channels == ("Jane:M001", "Jane:brow", "Tom:brow")
    with pytest.raises(NameMismatchError, match="found brow in the map, expected labels of the take"):
        own_labels(found, {"brow": ""})


def test_a_map_leaves_out_a_whole_subject() -> None:
    found = ["Jane:M001", "Joe:M001", "Jane:M002", "Joe:M002"]
    assert match_labels(found, KNOWN, {"Jane:*": ""}).channels == ("Joe:M001", "Joe:M002")
    assert own_labels(found, {"Jane:*": ""}).labels == ("M001", "M002")


@pytest.mark.parametrize(
    ("found", "renamed", "said"),
    [
        (("A:M001", "B:M001"), None, "found 'A:M001' and 'B:M001' for the marker 'M001'"),
        (("x", "y"), None, "found x, y, expected some of the attachment's: M001"),
        (("M001",), {"M009": "M001"}, "found M009 in the map, expected labels of the take"),
        (("M001",), {"M001": "nose"}, "found nose in the map, expected labels of the attachment"),
    ],
)
def test_what_cannot_be_decided_is_said(found: tuple[str, ...], renamed: dict[str, str] | None, said: str) -> None:
    with pytest.raises(NameMismatchError, match=said):
        match_labels(found, KNOWN, renamed)


def test_without_an_attachment_every_labelled_marker_counts() -> None:
    match = own_labels(["Actor:a", "Actor:b", "*3", "unlabeled4", "Actor:*5", "helmet"], {"helmet": ""})
    assert match.labels == ("a", "b")
    assert match.unmatched == ("*3", "unlabeled4", "Actor:*5", "helmet")
    # Two subjects: the prefix is what distinguishes them.
    assert own_labels(["A:a", "B:a"]).labels == ("A:a", "B:a")
