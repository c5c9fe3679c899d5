"""A graph is exported once, and anew where what was kept is damaged or what it is made of has changed."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import sleep

import pytest
from onnx import ModelProto, TensorProto, helper

from torchface import zoo
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.workflows.cached_graph import cached_graph


class Maker:
    """Makes a graph, and counts how often."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> ModelProto:
        self.count += 1
        start, end = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in ("x", "y"))
        return helper.make_model(helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "g", [start], [end]))


def test_it_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHFACE_CACHE", str(tmp_path))
    make, network = Maker(), zoo.get_model("eye_network", EyeNetwork)

    def graph(code: str = "landmarks/images/networks", kind: str = "eyes") -> bytes:
        return cached_graph(kind, make, (code,), network=network)

    content = graph()
    assert graph() == content == make().SerializeToString()
    assert make.count == 2  # one of them above
    (path,) = tmp_path.rglob("*.onnx")
    path.write_bytes(content[:-1])  # damaged
    assert graph() == content
    assert path.read_bytes() == content
    assert make.count == 3
    path.with_suffix(".sha256").unlink()
    assert graph() == content
    assert make.count == 4
    network.heat.bias.data[0] += 1  # another model
    graph()
    graph("landmarks/images/trees")  # other code
    graph(kind="other")
    assert make.count == 7


def test_of_two_that_ask_at_once_one_makes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHFACE_CACHE", str(tmp_path))
    make = Maker()

    def slowly() -> ModelProto:
        made = make()
        sleep(0.3)
        return made

    with ThreadPoolExecutor() as runs:
        first, second = runs.map(lambda _: cached_graph("eyes", slowly, ()), range(2))
    assert first == second
    assert make.count == 1


def test_a_cache_that_cannot_be_written_to_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("TORCHFACE_CACHE", str(tmp_path / "file"))
    make = Maker()
    assert cached_graph("eyes", make, ()) == cached_graph("eyes", make, ())
    assert make.count == 2
