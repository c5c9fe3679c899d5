"""Models of Hugging Face repositories: a server of one's own speaks the Hub's routes; nothing leaves this machine."""

import hashlib
import re
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from torchface import zoo
from torchface.capture import MarkerSolver, ShapePrior
from torchface.errors import FileFormatError, MissingExtraError, NameMismatchError

COMMIT = "1" * 40
FILES = Path(__file__).resolve().parents[2] / "models" / "shape_prior"


class Hub(BaseHTTPRequestHandler):
    """Repositories as the Hub serves files: ``/owner/name/resolve/REVISION/PATH``."""

    repositories: ClassVar[dict[str, dict[str, bytes]]] = {}
    asked: ClassVar[list[str]] = []
    tokens: ClassVar[defaultdict[str, set[str]]] = defaultdict(set)

    def do_HEAD(self) -> None:
        self._answer(False)

    def do_GET(self) -> None:
        self._answer(True)

    def _answer(self, whole: bool) -> None:
        self.asked.append(f"{self.command} {self.path}")
        self.tokens[self.headers["Host"].partition(":")[0]].add(self.headers.get("Authorization", ""))
        found = re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", self.path)
        files = self.repositories.get(found[1]) if found else None
        if found is None or files is None:
            return self._refuse("RepoNotFound")
        if found[1].endswith("gated"):
            return self._refuse("GatedRepo", 403)
        if found[2] not in ("main", "v1", COMMIT):
            return self._refuse("RevisionNotFound")
        if found[3] not in files:
            return self._refuse("EntryNotFound")
        data = files[found[3]]
        moved = found[1] == "studio/moved" and self.headers["Host"].startswith("127.")
        self.send_response(302 if moved else 200)
        if moved:  # as the Hub sends large files from a host of their own
            self.send_header("Location", f"http://localhost:{self.server.server_address[1]}{self.path}")
            self.send_header("X-Linked-ETag", f'"{hashlib.sha256(data).hexdigest()}"')
            self.send_header("X-Linked-Size", str(len(data)))
            data = b""
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("ETag", f'"{hashlib.sha256(data).hexdigest()}"')
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if whole:
            self.wfile.write(data)

    def _refuse(self, code: str, status: int = 404) -> None:
        self.send_response(status)
        self.send_header("X-Error-Code", code)
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, dict[str, bytes]]]:
    """Repositories that are served, by name and path, and caches that are empty."""
    from huggingface_hub import constants

    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("TORCHFACE_CACHE", str(tmp_path / "ours"))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "theirs"))
    monkeypatch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    whole = {path.name: path.read_bytes() for path in FILES.iterdir()}
    Hub.asked.clear()
    Hub.tokens.clear()
    Hub.repositories = {
        "studio/prior": {**whole, "curves.png": b"a picture", "state.bin": b"a pickle"},
        "studio/several": {f"faces/shape/{name}": data for name, data in whole.items()},
        "studio/gated": whole,
        "studio/moved": whole,
        "studio/words": {"config.json": b"{}", "model.safetensors": b""},
    }
    yield Hub.repositories
    server.shutdown()
    server.server_close()


def fetched() -> set[str]:
    return {line.rpartition("/")[2] for line in Hub.asked if line.startswith("GET")}


@pytest.mark.parametrize("name", ["hf://studio/prior", "hf://studio/prior@v1", "hf://studio/several/faces/shape"])
def test_a_repository_gives_the_model_and_nothing_else_is_fetched(hub: dict[str, dict[str, bytes]], name: str) -> None:
    model = zoo.get_model(name, ShapePrior)
    for key, value in zoo.get_model("shape_prior").state_dict().items():
        assert torch.equal(model.state_dict()[key], value)
    assert fetched() == {"model.toml", "state.safetensors", "CARD.md"}
    files = [path for path in zoo.find(name).iterdir() if path.name != ".cache"]  # huggingface_hub's record of them
    assert sorted(path.name for path in files) == ["CARD.md", "model.toml", "state.safetensors"]
    assert not any(path.is_symlink() for path in files)


def test_a_token_goes_to_the_hub_and_not_where_it_sends_on(
    hub: dict[str, dict[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    assert zoo.get_model("hf://studio/moved", ShapePrior).names
    assert "Bearer hf_secret" in Hub.tokens["127.0.0.1"]
    assert Hub.tokens["localhost"] == {""}


def test_a_description_does_not_fetch_the_state(hub: dict[str, dict[str, bytes]]) -> None:
    found = zoo.describe("hf://studio/several@v1/faces/shape")
    assert (found.name, found.kind, found.licence) == ("shape", "shape_prior", "MIT")
    assert found.url == "hf://studio/several@v1/faces/shape"
    assert zoo.describe("hf://studio/prior").name == "prior"
    with pytest.raises(NameMismatchError, match=r"found hf://studio/prior, a ShapePrior, expected a MarkerSolver"):
        zoo.get_model("hf://studio/prior", MarkerSolver)
    assert fetched() == {"model.toml", "CARD.md"}


def test_what_was_fetched_once_needs_no_network(
    hub: dict[str, dict[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    names = zoo.get_model("hf://studio/prior", ShapePrior).names
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    asked = len(Hub.asked)
    assert zoo.get_model("hf://studio/prior", ShapePrior).names == names
    assert len(Hub.asked) == asked
    with pytest.raises(FileFormatError, match=r"several@main/faces/shape: cannot be reached, and model.toml was not"):
        zoo.get_model("hf://studio/several/faces/shape")


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("hf://studio/nothing", NameMismatchError, "found no such repository"),
        ("hf://studio/gated", NameMismatchError, "whose owner asks for consent"),
        ("hf://studio/prior@v9", NameMismatchError, "found no such revision"),
        ("hf://studio/words", FileFormatError, r"found no model.toml, expected a model's folder"),
        ("hf://studio/prior/faces", FileFormatError, r"prior@main/faces: found no model.toml"),
        ("hf://studio", NameMismatchError, r"found 'hf://studio', expected hf://OWNER/NAME"),
        ("hf://studio/prior/../../x", NameMismatchError, "expected hf://OWNER/NAME"),
        ("hf://studio/prior@..", NameMismatchError, "expected hf://OWNER/NAME"),
        ("hf://studio/prior@../../x", NameMismatchError, "expected hf://OWNER/NAME"),
        ("hf://../prior", NameMismatchError, "expected hf://OWNER/NAME"),
        ("hf://studio/prior@v1@v2", NameMismatchError, "expected hf://OWNER/NAME"),
    ],
)
def test_what_cannot_be_had_is_told(
    hub: dict[str, dict[str, bytes]], name: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        zoo.get_model(name)
    assert fetched() == set()


@pytest.mark.parametrize(
    ("file", "change", "message", "fetches"),
    [
        ("model.toml", lambda data: data + b"#" * 2**18, r"found model.toml of \d+ bytes, expected at most", set()),
        ("CARD.md", lambda data: data * 2**10, r"found CARD.md of \d+ bytes, expected at most", {"model.toml"}),
        (
            "model.toml",
            lambda data: data.replace(b'kind = "shape_prior"', b'kind = "os.system"'),
            "found kind 'os.system', expected",
            {"model.toml"},
        ),
        (
            "model.toml",
            lambda data: re.sub(rb"(?m)^size = \d{5}$", b"size = 1000000000000", data, count=1),
            r"found size = 1000000000000, expected at most \d+, which its config asks for",
            {"model.toml"},
        ),
        (
            "state.safetensors",
            lambda data: data + b"\0",
            r"found state.safetensors of \d+ bytes, expected \d+$",
            {"model.toml", "CARD.md"},
        ),
        (
            "state.safetensors",
            lambda data: data[:-1] + bytes([data[-1] ^ 1]),
            r"state.safetensors: found sha256 \w{64}, expected \w{64} as in model.toml",
            {"model.toml", "CARD.md", "state.safetensors"},
        ),
        (
            "state.safetensors",
            None,
            r"found no state.safetensors, expected a model's folder",
            {"model.toml", "CARD.md"},
        ),
    ],
)  # fmt: skip
def test_sizes_are_held_against_the_description_before_anything_is_fetched(
    hub: dict[str, dict[str, bytes]],
    file: str,
    change: Callable[[bytes], bytes] | None,
    message: str,
    fetches: set[str],
) -> None:
    files = hub["studio/prior"]
    data = files.pop(file)
    if change is not None:
        files[file] = change(data)
    with pytest.raises(FileFormatError, match=message):
        zoo.get_model("hf://studio/prior")
    assert fetched() == fetches


def test_a_card_may_be_missing(hub: dict[str, dict[str, bytes]]) -> None:
    del hub["studio/prior"]["CARD.md"]
    assert isinstance(zoo.get_model("hf://studio/prior"), ShapePrior)
    with pytest.raises(FileFormatError, match=r"CARD.md: found no such file"):
        zoo.verify("hf://studio/prior")


def test_without_the_extra_its_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r"hf://studio/prior@main needs huggingface_hub, .* pip install"):
        zoo.get_model("hf://studio/prior")
