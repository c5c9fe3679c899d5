"""Landmarks and small documents built by chance: strategies of :func:`built_files.check_built`."""

import json
from typing import Any

import tomli_w
from built_files import LINE_ENDS, Files, altered, counts, numbers, seldom, words
from hypothesis import strategies as st


@st.composite
def dlib_files(draw: st.DrawFn) -> Files:
    """Tags of dlib's XML within each other in any order, their attributes missing or odd."""

    def tag(
        name: str, attributes: dict[str, st.SearchStrategy[str]], inner: st.SearchStrategy[str]
    ) -> st.SearchStrategy[str]:
        pairs = [
            seldom(st.just(""), value.map(lambda v, k=key: f" {k}='{v}'"), 30) for key, value in attributes.items()
        ]
        return st.tuples(st.tuples(*pairs).map("".join), inner).map(lambda made: f"<{name}{made[0]}>{made[1]}</{name}>")

    number, part_name = numbers(), seldom(numbers(), st.integers(0, 5).map(str), 20)
    part = tag("part", {"name": part_name, "x": number, "y": number}, st.just(""))
    box = tag(
        "box",
        {"top": number, "left": number, "width": number, "height": number, "ignore": st.sampled_from(["0", "1", ""])},
        st.lists(part, max_size=4).map("".join),
    )
    image = tag(
        "image",
        {"file": st.sampled_from(["a.png", "../a", ""])},
        st.lists(seldom(part, box, 10), max_size=3).map("".join),
    )
    strange = st.sampled_from(
        ["<image file='a'/>", "</box>", "<box/>", "<!ENTITY a 'b'>", "&a;", "<dataset>", "<?xml?>", "<!--a-->"]
    )
    text = "".join(draw(st.lists(seldom(strange | box | part, image, 8), max_size=4)))
    return {"case.xml": f"<dataset><images>{text}</images></dataset>".encode()}


@st.composite
def pts_files(draw: st.DrawFn) -> Files:
    """A head, a count and points between braces."""
    points = draw(st.integers(0, 5))
    rows = [draw(words(numbers(), 2) | seldom(words(numbers(), 0, 4), words(numbers(), 2), 6)) for _ in range(points)]
    lines = ["version: 1", f"n_points: {draw(counts(points))}", "{", *rows, "}"]
    return {"case.pts": draw(st.sampled_from(LINE_ENDS)).join(map(str, draw(altered(lines, 1)))).encode()}


def _documents(name: str, document: Any) -> st.SearchStrategy[Files]:
    """JSON, or TOML by the name's ending, with values replaced."""

    def packed(made: Any) -> bytes:
        if name.endswith(".toml"):
            made = _without_none(made) if isinstance(made, dict) else {"a": _without_none(made)}
            return tomli_w.dumps(made).encode("utf-8", "replace")
        return json.dumps(made).encode()

    return altered(document).map(lambda made: {name: packed(made)})


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_none(inner) for key, inner in value.items() if inner is not None}
    return [_without_none(inner) for inner in value if inner is not None] if isinstance(value, list) else value


def ljson_files() -> st.SearchStrategy[Files]:
    """LJSON of three versions."""
    points = {"points": [[1, 2], [3, 4], [None, None]], "connectivity": [[0, 1]]}
    labels = [{"label": "nose", "mask": [0, 1]}, {"label": "chin", "mask": [2]}]
    first = {"version": 1, "groups": [{"label": "nose", "landmarks": [{"point": [1, 2]}, {"point": [3, 4]}]}]}
    second = {"version": 2, "landmarks": points, "labels": labels}
    third = {"version": 3, "groups": {"LJSON": {"landmarks": points, "labels": labels}}}
    return st.sampled_from([first, second, third]).flatmap(lambda made: _documents("case.ljson", made))


def landmark_files() -> st.SearchStrategy[Files]:
    """Picked vertices."""
    picks = {"format": "torchface.landmarks/1", "fingerprint": "8-ab", "labels": ["a", "b"], "vertices": [3, 4]}
    return _documents("case.json", picks)


def correspondence_files() -> st.SearchStrategy[Files]:
    """Pairs of vertex and point."""
    pairs = {
        "format": "torchface.correspondences/1",
        "labels": ["a", "b"],
        "vertices": [3, 4],
        "points": [[0, 1, 2.5]] * 2,
    }
    return _documents("case.json", pairs)


def attachment_files() -> st.SearchStrategy[Files]:
    """Markers on triangles."""
    document = {
        "format": "torchface.attachment/1",
        "triangles": [0, 1],
        "barycentric": [[0.2, 0.3, 0.5]] * 2,
        "labels": ["a", "b"],
        "residual": [[0, 0, 1.5]] * 2,
        "fingerprint": "8-ab",
    }
    return _documents("case.json", document)


def annotation_files() -> st.SearchStrategy[Files]:
    """Landmarks of scans."""
    scan = {"points": {"nose": [0, 1, 2]}, "lines": {"lips": [[0, 1, 2], [3, 4, 5]]}}
    return _documents("case.json", {"format": "torchface.scan-annotations/1", "unit": "mm", "scans": {"a.obj": scan}})


def camera_files() -> st.SearchStrategy[Files]:
    """A calibration."""
    document = {
        "format": "torchface.camera/1",
        "width": 640,
        "height": 480,
        "focal": [600.0, 600.0],
        "skew": 0.0,
        "center": [320.0, 240.0],
        "distortion": {"k1": 0.1, "p1": 0.0},
        "error": 0.2,
    }
    return _documents("case.toml", document)


def shape_rule_files() -> st.SearchStrategy[Files]:
    """Rules of retargeting."""
    return _documents(
        "case.toml", {"jaw": {"sum": {"a": 0.5, "b": 1}, "gain": 2.0, "upper": 0.8}, "c": {"product": ["a", "b"]}}
    )


def shape_table_files() -> st.SearchStrategy[Files]:
    """Shapes of action units."""
    return _documents(
        "case.toml",
        {"format": "torchface.action_unit_shapes/1", "units": {"AU1": {"browInnerUp": 0.5}, "AU2": {"a": 1.0}}},
    )


def model_files() -> st.SearchStrategy[Files]:
    """The description of a saved model."""
    document = {
        "format": 1,
        "kind": "a",
        "licence": "MIT",
        "data": "b",
        "sha256": "0" * 64,
        "size": 100,
        "metrics": {"error": 0.5},
        "settings": {"steps": 10},
        "config": {"width": 64, "names": ["a", "b"]},
    }
    return _documents("model/model.toml", document)


def action_label_files() -> st.SearchStrategy[Files]:
    """What a person says of a painted face."""
    document = {
        "format": "torchface.action_labels/1",
        "frames": 100,
        "neutral": 3,
        "helmet": [1, 2],
        "markers": [[3, 4], [5, 6]],
        "regions": {"brow": [0, 0, 10, 10]},
        "performed": [{"units": ["AU1"], "first": 5, "last": 9}],
    }
    return _documents("case.toml", document)
