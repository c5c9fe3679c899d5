"""The examples in docstrings run as they are written, in either float format (float64 in the bench)."""

import doctest
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import torchface

LIBRARY = Path(torchface.__file__).resolve().parent
# By their text: importing and searching the whole library costs more than the examples do.
MODULES = sorted(
    ".".join(("torchface", *path.relative_to(LIBRARY).with_suffix("").parts)).removesuffix(".__init__")
    for path in LIBRARY.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
# What holds float32 whatever numbers become: files, pictures and their figures, graphs, the sculpted performer.
FLOAT32 = (
    "torchface.capture.action_units.classifier",
    "torchface.io.",
    "torchface.onnx.",
    "torchface.rendering.clay_shading",
    "torchface.synthetic.",
    "torchface.viz.",
)


@pytest.fixture(
    params=[torch.float32, pytest.param(torch.float64, marks=pytest.mark.bench)], ids=["float32", "float64"]
)
def float_format(request: pytest.FixtureRequest) -> Iterator[torch.dtype]:
    """What numbers become tensors of: examples show facts, which hold in both."""
    for name in MODULES:  # constants of a module have the format of its first import
        importlib.import_module(name)
    usual = torch.get_default_dtype()
    torch.set_default_dtype(request.param)
    yield request.param
    torch.set_default_dtype(usual)


# One to four seconds each; tests of their own do as much.
LONG = (
    "torchface.capture.action_units.classifier",
    "torchface.modeling.rigging.other_topology",
    "torchface.onnx.model_export",
    "torchface.onnx.module_graph",
    "torchface.synthetic.stages.wrinkles.wrinkled_performer",
)


@pytest.mark.usefixtures("coarse_figures")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.bench) if name in LONG else name for name in MODULES]
)
def test_examples_give_what_they_say(
    name: str, float_format: torch.dtype, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if float_format is torch.float64 and name.startswith(FLOAT32):
        pytest.skip("holds float32 whatever numbers become")
    monkeypatch.chdir(tmp_path)  # some write files
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    found = doctest.DocTestFinder().find(importlib.import_module(name), extraglobs={"torch": torch})
    written = [one for one in found if one.examples]  # each run of none looks at all source files that are known
    runner = doctest.DocTestRunner(optionflags=flags)
    assert written
    assert all(runner.run(one).failed == 0 for one in written)
