"""Where a template has the lines of lips and lids."""

from torchface.landmarks.scans.landmark_pairs import template_features
from torchface.landmarks.scans.uv_landmark_names import LINES
from torchface.synthetic import neutral_head


def test_lines_run_along_the_outermost_edges_that_touch() -> None:
    template = neutral_head(texture=False)
    features = template_features(template)
    lids = template.annotations.regions["lids_left"] | template.annotations.regions["lids_right"]
    assert set(features.lines) == set(LINES)
    for name, (left, right) in LINES.items():
        ids, shares = features.lines[name]
        middle = template.vertices[ids.view(-1, 2)].double().mean(1)
        assert (shares[::2].diff() > 0).all()
        # From lid to lid and back again would be twice as long as the eye is wide.
        chord = template.vertices[features.landmarks[right]] - template.vertices[features.landmarks[left]]
        assert (middle[1:] - middle[:-1]).norm(dim=1).sum() < 1.25 * chord.norm()
        kept, contacts = set(ids.tolist()), template.annotations.contacts
        rest = [pair for pair in contacts.tolist() if not kept & set(pair) and bool(lids[pair[0]])]
        for pair in rest if "lids" in name else []:
            point = template.vertices[pair].double().mean(0)
            beside = (middle[:, :2] - point[:2]).norm(dim=1)
            if float(beside.min()) < 2.0:
                assert point[2] < middle[beside.argmin(), 2]
