"""Characters whose JSON is damaged at random are refused by an error of torchface, or read; nothing else happens."""

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import torch

from planted.characters import Planted, write_character
from planted.glb_files import packed, unpacked
from torchface import Mesh, TorchfaceError
from torchface.io.gltf.character_scene import read_character
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.morph_insertion import AddedTargets, document_with_targets, write_edited
from torchface.io.vrm.vrm_expressions import MorphBind, add_expressions

HEAD = Mesh(torch.tensor([[0.0, 0, 0], [50, 0, 0], [0, 50, 0]]), torch.tensor([[0, 1, 2]]))
WRONG = (None, -1, 10**6, 0.5, "text", [], {}, [[]], True, 1e300)


def places(value: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Every container of a document and the keys in it."""
    for key in value if isinstance(value, dict) else range(len(value)):
        found.append((value, key))
        if isinstance(value[key], dict | list):
            places(value[key], found)
    return found


def test_damaged_documents_end_in_errors_of_our_own(tmp_path: Path) -> None:
    lift = {"lid": torch.ones(3, 3), "grin": torch.ones(3, 3)}
    draws, read = random.Random(1), 0
    for version, expression in (("VRMC_vrm", "blinkLeft"), ("VRM", "blink_l")):
        whole = tmp_path / "whole.vrm"
        count = write_character(whole, HEAD, lift, Planted(vrm=version, expressions={expression: "lid"}))
        root, binary = unpacked(whole)
        for _ in range(60):
            broken = copy.deepcopy(root)
            for _ in range(draws.randint(1, 3)):
                owner, key = draws.choice(places(broken, []))
                owner[key] = draws.choice(WRONG)
            path = tmp_path / "broken.vrm"
            path.write_bytes(packed(json.loads(json.dumps(broken)), binary))
            try:
                document = read_document(path)
                read_character(document)
                added = AddedTargets(0, (0,), np.zeros((1, count, 3), np.float32))
                edited, data = document_with_targets(document, [added], ["jawOpen"])
                add_expressions(document, edited, {"jawOpen": [MorphBind(0, 0, 2)]})
                write_edited(document, edited, data, tmp_path / "out.vrm")
                read += 1
            except TorchfaceError:
                pass
    assert read > 20
