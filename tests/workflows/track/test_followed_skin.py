"""Weights by the skin of a take's frames: a blink that was solved stays."""

from types import SimpleNamespace

import pytest
import torch

from torchface.capture.own_rig.skin_motion import SkinMotion
from torchface.progress import silent
from torchface.synthetic import performer
from torchface.workflows.track import followed_skin


def test_skin_that_rises_takes_no_blink_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """One blink of twenty was lost in rendered films: of a blink and an ``eyeWide``, the difference is left."""
    rig = performer(texture=False)
    blink, wide, brow = (rig.names.index(name) for name in ("eyeBlinkLeft", "eyeWideLeft", "browInnerUp"))
    weights, change = torch.zeros(40, len(rig.names)), torch.zeros(40, len(rig.names))
    weights[10:20, blink], weights[:, brow] = 0.5, 0.4
    change[:, wide] = 0.2
    change[:20, brow], change[20:, brow] = 0.1, -0.1
    deviation = torch.tensor([torch.inf if name.startswith(("eyeBlink", "eyeLook")) else 0.3 for name in rig.names])
    monkeypatch.setattr(followed_skin, "skin_motion", lambda *given: SkinMotion(change, deviation))
    inputs = SimpleNamespace(clip=SimpleNamespace(fps=30.0, color_frames=list), actor=rig, calibration=None)
    solved = SimpleNamespace(weights=weights, rotation=None, translation=None, solved=torch.ones(40).bool())
    found = followed_skin.followed_weights(inputs, solved, None, silent)
    torch.testing.assert_close(found[:, blink], weights[:, blink])
    assert not found[10:20, wide].any()
    torch.testing.assert_close(found[:10, wide], torch.full((10,), 0.2))
    assert found[5, brow] > 0.45 > 0.35 > found[35, brow]
