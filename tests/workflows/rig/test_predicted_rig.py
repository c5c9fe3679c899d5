"""A rig from a neutral head alone: what the command writes, its report, and heads and models that do not fit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, load_rig, save_mesh, save_rig, zoo
from torchface.cli import main
from torchface.errors import NameMismatchError, TopologyError
from torchface.modeling import ExpressionRegression
from torchface.workflows.rig.predicted_rig import predict_rig


@pytest.fixture(scope="module")
def folder(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A template, a model of people whose jaw opens as far as they are tall, and a tall head."""
    folder = tmp_path_factory.mktemp("predicted")
    save_rig(dome_rig, folder / "template.glb")
    heights = torch.linspace(0.8, 1.25, 8)[:, None, None]
    heads = dome_rig.vertices * torch.cat([torch.ones(8, 1, 2), heights], -1)
    jaws = heads[:, None] + (2 * heights[:, None] - 1) * dome_rig.deltas[:1]
    model = ExpressionRegression.fit(heads, jaws, names=["jawOpen"], topology=dome_rig.neutral.fingerprint())
    model.errors.copy_(torch.tensor([[1.0], [400.0]]))
    zoo.save_model(model, folder / "jaws", zoo.ModelCard("MIT", "domes", {}, ""))
    save_mesh(dome_rig.neutral.with_vertices(dome_rig.vertices * torch.tensor([1.0, 1.0, 1.2])), folder / "tall.obj")
    return folder


def test_a_head_gets_predicted_and_transferred_shapes(
    folder: Path, dome_rig: BlendshapeRig, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--template", folder / "template.glb", "--expressions", folder / "jaws", "--out", folder / "tall.glb"]
    main(["rig", "--neutral", str(folder / "tall.obj"), *map(str, words), "--quiet"])
    assert "of 4 shapes 1 predicted by jaws, 3 transferred" in capsys.readouterr().err
    made = load_rig(folder / "tall.glb")
    assert (made.deltas[0] - 1.4 * dome_rig.deltas[0]).norm(dim=1).max() < 0.1
    page = (folder / "tall_shapes" / "index.html").read_text()
    assert page.count("<td>transferred</td>") == 3
    assert (folder / "tall_shapes" / "shapes.png").is_file()


def test_heads_and_models_that_do_not_fit_are_named(
    folder: Path, dome_rig: BlendshapeRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, template = tmp_path / "out.glb", folder / "template.glb"
    other = replace(dome_rig.neutral, faces=dome_rig.neutral.faces[:-2], polygons=None)
    save_mesh(other, tmp_path / "cut.obj")
    with pytest.raises(TopologyError, match=r"cut\.obj: found topology"):
        predict_rig(tmp_path / "cut.obj", out, folder / "jaws", template)
    with pytest.raises(TopologyError, match=r"expressions: found expressions of topology 6419-.*expected that of"):
        predict_rig(folder / "tall.obj", out, template=template)
    save_rig(dome_rig.select(dome_rig.names[1:]), tmp_path / "jawless.glb")
    with pytest.raises(NameMismatchError, match=r"expressions: found .* of jawOpen, expected some of the shapes"):
        predict_rig(folder / "tall.obj", out, folder / "jaws", tmp_path / "jawless.glb")
    for words in ([], ["--neutral", str(folder / "tall.obj"), "--pose", "eyeBlinkLeft=1"], ["scan.obj"]):
        with pytest.raises(SystemExit):
            main(["rig", *words, "--out", str(out)])
    told = " ".join(capsys.readouterr().err.split())
    assert "expected a SCAN and --template RIG, or --neutral HEAD" in told
    assert "--neutral: found --pose beside it" in told
    assert not out.exists()
