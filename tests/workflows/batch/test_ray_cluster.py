"""On a Ray cluster of two nodes each item is done once and whole, whatever is killed meanwhile; `make test-cluster`."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from slow_items import WORDS, SpellJob, written_words

from torchface.errors import ValueRangeError
from torchface.workflows.batch import ray_cluster
from torchface.workflows.batch.batch_items import find_items
from torchface.workflows.batch.outcomes import Outcome
from torchface.workflows.batch.run_batch import BatchOptions, BatchReport, run_batch

pytestmark = [pytest.mark.cluster, pytest.mark.slow]

NODE = {
    "num_cpus": 1,
    "object_store_memory": 80 * 2**20,
    "include_log_monitor": False,
}
TEXTS = {f"w{i}": f"word {i}" for i in range(8)}
DRIVER = """
import sys
from pathlib import Path
from slow_items import WORDS, SpellJob
from torchface.workflows.batch.batch_items import find_items
from torchface.workflows.batch.run_batch import BatchOptions, run_batch

words, address = Path(sys.argv[1]), sys.argv[2]
job = SpellJob(words.parent / "log", pause=1.0)
run_batch(job, WORDS, find_items([words], WORDS), words.parent / "out", BatchOptions(cluster=address))
"""


@pytest.fixture(scope="module")
def shared_cluster() -> Iterator[Any]:
    """A Ray cluster on this machine, of what batches need alone."""
    ray = pytest.importorskip("ray", reason="ray is not installed: pip install '.[cluster]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
        from ray.cluster_utils import Cluster

        made = Cluster(initialize_head=True, head_node_args=NODE | {"include_dashboard": False, "no_monitor": True})
        try:
            yield made
        finally:
            ray.shutdown()
            made.shutdown()


@pytest.fixture
def cluster(shared_cluster: Any) -> Any:
    """The cluster with two nodes of one CPU each; the second is ``cluster.second``."""
    if not shared_cluster.worker_nodes:
        shared_cluster.second = shared_cluster.add_node(**NODE)
    return shared_cluster


@pytest.fixture
def words(tmp_path: Path) -> Path:
    return written_words(tmp_path, TEXTS)


def run(words: Path, options: BatchOptions, pause: float = 0.0, **more: Any) -> BatchReport:
    job = SpellJob(words.parent / "log", pause)
    return run_batch(job, WORDS, find_items([words], WORDS), words.parent / "out", options, **more)


def check_whole(words: Path, report: BatchReport) -> None:
    """Each word is there once, whole, with its record, and nothing else."""
    assert [outcome.name for outcome in report.done] == list(TEXTS)
    for name, text in TEXTS.items():
        assert (report.out / name / "word.txt").read_text() == text[::-1]
        assert json.loads((report.out / "records" / f"{name}.json").read_text())["status"] == "done"
    assert sorted(path.name for path in report.out.iterdir()) == sorted(
        [*TEXTS, "records", "summary.csv", "contact_sheet.png"]
    )
    assert sorted(path.stem for path in (report.out / "records").iterdir()) == sorted(TEXTS)


def test_what_is_no_cluster_is_told_within_20_seconds(words: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before any cluster runs here, which ``auto`` would find."""
    pytest.importorskip("ray", reason="ray is not installed: pip install '.[cluster]'")
    assert ray_cluster._SECONDS_TO_ANSWER + 1 + ray_cluster._SECONDS_TO_JOIN < 20  # what is left is Ray's loading
    monkeypatch.setattr(ray_cluster, "_SECONDS_TO_JOIN", 2.0)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        addresses = ("nonsense", "127.0.0.1:1", "127.0.0.1:99999", "auto", f"127.0.0.1:{silent.getsockname()[1]}")
        for address in addresses:
            with pytest.raises(ValueRangeError, match=f"found no Ray cluster at '{address}'"):
                run(words, BatchOptions(cluster=address))

    def slow(*_: Any) -> None:  # as where no name server answers
        time.sleep(5)
        raise OSError

    with monkeypatch.context() as patch:
        patch.setattr(ray_cluster, "_SECONDS_TO_ANSWER", 0.1)
        patch.setattr(socket, "create_connection", slow)
        with pytest.raises(ValueRangeError, match="nobody answered within"):
            run(words, BatchOptions(cluster="far.example:6379"))
    assert not (words.parent / "out").exists()


def test_a_driver_that_is_killed_and_started_again_does_each_item_once(cluster: Any, words: Path) -> None:
    out = words.parent / "out"
    process = subprocess.Popen([sys.executable, "-c", DRIVER, str(words), cluster.address])
    limit = time.monotonic() + 240
    try:
        while len(list(out.glob("records/*.json"))) < 2 and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.05)
    finally:
        process.kill()
        process.wait()
    finished = {path.name: path.stat().st_mtime_ns for path in out.glob("records/*.json")}
    assert 2 <= len(finished) < len(TEXTS)
    report = run(words, BatchOptions(cluster=cluster.address), pause=1.0)
    check_whole(words, report)
    assert sum(outcome.reused for outcome in report.outcomes) >= len(finished)
    for name, when in finished.items():
        assert (out / "records" / name).stat().st_mtime_ns == when  # what was finished is not made again


def test_a_killed_worker_and_a_lost_node_cost_no_item(cluster: Any, words: Path) -> None:
    job = SpellJob(words.parent / "log")
    (words / "x.txt").write_text("dies once")
    (words / "y.txt").write_text("sleeps")
    (words / "z.txt").write_text("nan")
    lost: list[str] = []

    def lose_a_node(outcome: Outcome) -> None:
        if not lost:
            lost.append(outcome.name)
            cluster.remove_node(cluster.second, allow_graceful=False)

    options = BatchOptions(cluster=cluster.address, time_limit=8)
    report = run(words, options, pause=0.3, finished=lose_a_node)
    assert lost
    found = {outcome.name: outcome for outcome in report.outcomes}
    assert all(found[name].done for name in (*TEXTS, "x"))
    assert job.attempts("x") == 2  # killed in the first
    assert "time limit of 8 seconds" in found["y"].error
    assert job.attempts("y") == 1
    assert "found NaN" in found["z"].error
    for name, text in TEXTS.items():
        assert (report.out / name / "word.txt").read_text() == text[::-1]
        assert job.attempts(name) <= 2  # one that was under way on the lost node is begun again
