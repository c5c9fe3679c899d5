"""Models saved under the names of yesterday: they give the same numbers today, and nothing else is let in."""

import hashlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import tomli_w
import torch
from torch import Tensor, nn

from torchface import zoo
from torchface.capture import ActionUnitClassifier, DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.capture.action_units import RegionGroup
from torchface.capture.action_units.classifier import GroupSize
from torchface.capture.priors import ParzenDensity, ReciprocalPrior, StudentDensity
from torchface.errors import FileFormatError
from torchface.files.models import CARD, DESCRIPTION, STATE, read_record, write_model
from torchface.files.state_renames import CONFIG_RENAMES, STATE_RENAMES, current_config, current_state_keys

REPOSITORY = Path(__file__).resolve().parents[2]
ABOUT = zoo.ModelCard("MIT", "noise", {}, "python -m train.none")
NAMES = ("jawOpen", "mouthPucker", "browInnerUp")


def under_new_keys(folder: Path) -> None:
    """Rewrites a saved model under the names of today, values and card untouched.

    For a model of the repository: ``PYTHONPATH=.:tests python -c "from pathlib import Path; from test_state_renames
    import under_new_keys; under_new_keys(Path('models/NAME'))"``.
    """
    model, record, card = zoo.get_model(folder), read_record(folder), (folder / CARD).read_bytes()
    stored = safetensors.torch.load_file(folder / STATE)
    names = current_state_keys(record.kind, stored, model.state_dict())
    half = [names[key] for key, tensor in stored.items() if tensor.dtype == torch.float16]
    write_model(model, folder, record, half=half)
    (folder / CARD).write_bytes(card)


def under_old_keys(folder: Path, renames: Mapping[str, str], config: Mapping[str, str] | None = None) -> set[str]:
    """Makes a saved model one of yesterday; returns the keys that its state has now."""
    stored = safetensors.torch.load_file(folder / STATE)
    old = {}
    for key, tensor in stored.items():
        matching = [(before, now) for before, now in renames.items() if key == now or key.endswith(f".{now}")]
        old[key.removesuffix(matching[0][1]) + matching[0][0] if matching else key] = tensor
    state = safetensors.torch.save(old)
    document = tomllib.loads((folder / DESCRIPTION).read_text())
    document["config"] = renamed(document["config"], {now: before for before, now in (config or {}).items()})
    document |= {"sha256": hashlib.sha256(state).hexdigest(), "size": len(state)}
    (folder / STATE).write_bytes(state)
    (folder / DESCRIPTION).write_text(tomli_w.dumps(document))
    return set(old)


def renamed(value: Any, names: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {names.get(key, key): renamed(inner, names) for key, inner in value.items()}
    return [renamed(inner, names) for inner in value] if isinstance(value, list) else value


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def shape_prior() -> ShapePrior:
    samples = 0.3 * noise(60, 3).abs()
    return ShapePrior(NAMES, ((0, 1), (2,)), [StudentDensity.fit(samples[:, :2]), StudentDensity.fit(samples[:, 2:])])


def reciprocal_prior() -> ReciprocalPrior:
    samples = 0.3 * noise(60, 3).abs()
    return ReciprocalPrior(
        NAMES, ((0, 1), (2,)), [StudentDensity.fit(samples[:, :2]), ParzenDensity.fit(samples[:, 2:])]
    )


def dynamics_prior() -> DynamicsPrior:
    takes = [(0.3 + 0.05 * noise(60, 3, seed=seed).cumsum(0)).clamp(0, 1) for seed in range(2)]
    return DynamicsPrior.fit(takes, NAMES, 3, settings=DynamicsSettings(inducing=10, subset=50, iterations=2))


def action_units() -> ActionUnitClassifier:
    model = ActionUnitClassifier([RegionGroup("mouth", ("mouth",), ("18L",), ("9",))], [GroupSize(2, 3)], 16)
    part = model.group_classifiers()[0]
    part.components.copy_(noise(*part.components.shape))
    part.machine.weight.copy_(noise(*part.machine.weight.shape, seed=1))
    part.intensities.copy_(torch.tensor([[0.0], [0.5], [1.0]]))
    return model


def outputs(model: nn.Module) -> list[Tensor]:
    """Numbers that depend on all of a model's state."""
    if isinstance(model, DynamicsPrior):
        return list(model(0.5 + 0.1 * noise(4, 3, 3, seed=5)))
    if isinstance(model, ActionUnitClassifier):
        return [model.group_classifiers()[0].scores(noise(4, 1, 16, 16, seed=5), noise(1, 16, 16, seed=6))]
    energy = model.energy(0.2 * noise(4, 3, seed=5).abs())
    return [energy.H, energy.f]


@pytest.mark.parametrize("make", [action_units, shape_prior, reciprocal_prior, dynamics_prior])
def test_a_model_saved_under_old_keys_gives_the_same_numbers(make: Any, tmp_path: Path) -> None:
    model, folder = make(), tmp_path / "model"
    kind = zoo.save_model(model, folder, ABOUT).kind
    keys = under_old_keys(folder, STATE_RENAMES[kind], CONFIG_RENAMES.get(kind))
    assert (read_record(folder).config != model.config) == (kind in CONFIG_RENAMES)
    assert keys != set(model.state_dict())
    for found, wanted in zip(outputs(zoo.get_model(folder)), outputs(model.eval()), strict=True):
        assert torch.equal(found, wanted)
    under_new_keys(folder)
    assert set(safetensors.torch.load_file(folder / STATE)) == set(model.state_dict())
    for key, tensor in zoo.get_model(folder).state_dict().items():
        assert torch.equal(tensor, model.state_dict()[key])


def test_keys_are_renamed_only_into_what_the_module_lacks() -> None:
    now = ["densities.0.degrees_of_freedom", "densities.0.factor"]
    assert current_state_keys("shape_prior", ["densities.0.freedom", "other.freedom", "freed"], now) == {
        "densities.0.freedom": now[0],
        "other.freedom": "other.freedom",
        "freed": "freed",
    }
    assert current_state_keys("video_solver", ["dynamics.learned.trust"], ["dynamics.learned.gain"]) == {
        "dynamics.learned.trust": "dynamics.learned.gain"
    }
    assert current_state_keys("head", ["densities.0.freedom"], now) == {"densities.0.freedom": "densities.0.freedom"}


def test_a_key_under_both_names_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    zoo.save_model(shape_prior(), folder, ABOUT)
    state = safetensors.torch.load_file(folder / STATE)
    state["densities.1.freedom"] = state["densities.1.degrees_of_freedom"].clone()
    (folder / STATE).write_bytes(safetensors.torch.save(state))
    under_old_keys(folder, {})
    with pytest.raises(FileFormatError, match=r"densities\.1\.freedom in one of them only"):
        zoo.get_model(folder)


def test_configs_are_renamed_at_any_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CONFIG_RENAMES, "made", {"rounds": "iterations"})
    old = {"rounds": 1, "parts": [{"rounds": [2]}, {"rounds": 3, "iterations": 4}], "names": ["rounds"]}
    new = {"iterations": 1, "parts": [{"iterations": [2]}, {"rounds": 3, "iterations": 4}], "names": ["rounds"]}
    assert current_config("made", old) == new
    assert current_config("head", old) == old


@pytest.mark.parametrize("name", sorted(path.parent.name for path in REPOSITORY.glob("models/*/model.toml")))
def test_the_models_that_come_along_have_the_keys_of_today(name: str) -> None:
    folder = REPOSITORY / "models" / name
    model = zoo.get_model(folder)
    assert set(safetensors.torch.load_file(folder / STATE)) == set(model.state_dict())
    assert set(read_record(folder).config) <= set(model.config)
