"""A Ray cluster of two nodes registers what this process would, also when one of the nodes is lost."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from torchface.errors import ValueRangeError
from torchface.io import load_mesh, save_mesh
from torchface.mesh import Mesh
from torchface.registration import Level, Schedule, Stage
from torchface.registration.corpus.register_corpus import register_corpus

pytestmark = [pytest.mark.cluster, pytest.mark.slow]

SHORT = Schedule((Stage(Level.GRAPH, 8.0, 8.0, 20.0, samples=300), Stage(Level.GRAPH, 0.5, 1.0, 8.0)), nodes=30)
COUNT = 8


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes of one CPU each, on this machine; the second is ``cluster.second``."""
    pytest.importorskip("ray", reason="ray is not installed: pip install '.[cluster]'")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    small = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
    made = Cluster(initialize_head=True, head_node_args=small)
    made.second = made.add_node(num_cpus=1, object_store_memory=80 * 2**20)
    yield made
    made.shutdown()


def test_a_lost_node_costs_no_scan(
    cluster: Any,
    make_mask: Callable[[int, int], Mesh],
    warp: Callable[[torch.Tensor], torch.Tensor],
    moved: Callable[..., torch.Tensor],
    rescanned: Callable[..., Mesh],
    tmp_path: Path,
) -> None:
    template, folder = make_mask(17, 23), tmp_path / "scans"
    folder.mkdir()
    for i in range(COUNT):
        true = moved(warp(template.vertices), i)
        save_mesh(rescanned(template.with_vertices(true), i), folder / f"s{i}.ply")
        points = {"points": true[template.landmarks].tolist()}
        (folder / f"s{i}.ljson").write_text(json.dumps({"version": 2, "labels": [], "landmarks": points}))
    (folder / "bad.ply").write_bytes(b"junk")
    lost: list[int] = []

    def lose_a_node(step: str, done: int = 0, total: int = 0) -> None:
        if done == 3 and not lost:
            cluster.remove_node(cluster.second, allow_graceful=False)
            lost.append(done)

    settings: dict[str, Any] = {"landmarks": folder, "schedule": SHORT, "texture_size": 0}
    found = register_corpus(
        template, [folder], tmp_path / "there", cluster=cluster.address, progress=lose_a_node, **settings
    )
    assert lost
    assert [entry.name for entry in found.registered] == [f"s{i}" for i in range(COUNT)]
    assert [entry.name for entry in found.skipped] == ["bad"]
    assert "no PLY header" in found.skipped[0].error
    here = register_corpus(template, [folder], tmp_path / "here", **settings)
    for one, other in zip(found.registered, here.registered, strict=True):
        assert one.result is not None
        assert other.result is not None
        torch.testing.assert_close(load_mesh(one.result).vertices, load_mesh(other.result).vertices, atol=1e-3, rtol=0)


def test_an_address_without_a_cluster_is_told(make_mask: Callable[[int, int], Mesh], tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="ray is not installed: pip install '.[cluster]'")
    (tmp_path / "bad.ply").write_bytes(b"junk")
    with pytest.raises(ValueRangeError, match="found no Ray cluster at 'nonsense'"):
        register_corpus(make_mask(17, 23), [tmp_path / "bad.ply"], tmp_path / "out", cluster="nonsense")
