"""Models of Hugging Face repositories in the layout of a model's folder; nothing else of a repository is fetched."""

from __future__ import annotations

import hashlib
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.cache_folder import cache_folder
from torchface.files.extra_packages import import_extra
from torchface.files.models import CARD, DESCRIPTION, MAX_CARD_BYTES, STATE, ModelRecord, check_claims
from torchface.files.whole_files import made_folder, write_file
from torchface.zoo.kinds import KINDS

_MAX_DESCRIPTION_BYTES = 2**18
_PART = r"[A-Za-z0-9][\w.-]{0,95}"
_REFERENCE = re.compile(rf"hf:/{{1,2}}({_PART}/{_PART})(?:@({_PART}))?((?:/{_PART})*)", re.ASCII)
_EXPECTED = "expected hf://OWNER/NAME, hf://OWNER/NAME@REVISION or hf://OWNER/NAME/FOLDER"
_LAYOUT = f"expected a model's folder as zoo.save_model writes it, {DESCRIPTION}, {STATE} and {CARD}"


@dataclass(frozen=True)
class HubReference:
    """A model's folder in a repository of the Hugging Face Hub.

    Args:
        repository: ``owner/name``.
        revision: a branch, tag or commit.
        folder: of the model in the repository; empty for the repository's own.
    """

    repository: str
    revision: str
    folder: str

    def __str__(self) -> str:
        return f"hf://{self.repository}@{self.revision}{'/' if self.folder else ''}{self.folder}"

    @property
    def name(self) -> str:
        """Of the model: its folder's, or the repository's."""
        return (self.folder or self.repository).rpartition("/")[2]


def hub_reference(text: str) -> HubReference | None:
    """What ``hf://owner/name[@revision][/folder]`` says; None where the text is of no such kind.

    Raises:
        NameMismatchError: it begins so and goes on otherwise.
    """
    if not text.startswith("hf:/"):
        return None
    found = _REFERENCE.fullmatch(text)
    if found is None:
        raise NameMismatchError(f"model: found {text[:200]!r}, {_EXPECTED}")
    return HubReference(found[1], found[2] or "main", found[3].strip("/"))


def fetch_description(reference: HubReference) -> Path:
    """A folder on this machine with a repository's ``model.toml`` and ``CARD.md``.

    Raises:
        MissingExtraError: ``huggingface_hub`` is not installed.
        NameMismatchError: there is no such repository or revision, or it is not shown to this user.
        FileFormatError: it has another layout, a file is too large, or it cannot be reached and was not fetched before.
    """
    repository = _Repository(reference)
    repository.fetch_card()
    return repository.folder


def fetch_model(reference: HubReference) -> Path:
    """A folder on this machine with a repository's model: its description, card and state.

    The description is read first. The state is fetched only where its kind is known and its size is what the
    description says and no more than the config asks for; what was fetched is kept only if it has the hash.

    Raises:
        as :func:`fetch_description`; and FileFormatError: the state is not what the description says.
    """
    repository = _Repository(reference)
    record = check_claims(repository.folder, KINDS)
    repository.fetch_card()
    repository.fetch_state(record)
    return repository.folder


class _Repository:
    """One commit of a repository, and the folder in which what was fetched of it lies as plain files.

    The package's own cache holds links, which a model's folder may not have.
    """

    def __init__(self, reference: HubReference) -> None:
        self._hub = import_extra("huggingface_hub", "huggingface_hub", "hub", str(reference))
        self._errors = import_extra("huggingface_hub.errors", "huggingface_hub", "hub", str(reference))
        self._reference = reference
        told = self._ask(DESCRIPTION, reference.revision, dry_run=True)
        self._commit: str = told.commit_hash
        owner, _, name = reference.repository.partition("/")
        self.folder = cache_folder("hub").joinpath(owner, name, self._commit, *reference.folder.split("/"))
        self._check_size(DESCRIPTION, told.file_size, _MAX_DESCRIPTION_BYTES)
        # Asked for by its revision, so that the package knows without a network which commit that was.
        fetched = self._ask(DESCRIPTION, reference.revision)
        if self._commit not in Path(fetched).parts:
            raise FileFormatError(f"{reference}: changed while it was fetched, expected one commit; try again")
        self._keep(DESCRIPTION, Path(fetched).read_bytes())

    def fetch_card(self) -> None:
        """Brings the card into the folder, if there is one."""
        with suppress(_MissingFileError):
            self._keep(CARD, self._read(CARD, MAX_CARD_BYTES))

    def fetch_state(self, record: ModelRecord) -> None:
        """Brings the state into the folder, if it is the one of this record."""
        if (self.folder / STATE).is_file():
            return
        data = self._read(STATE, record.size, exactly=True)
        if (found := hashlib.sha256(data).hexdigest()) != record.sha256:
            kept = self._ask(STATE, self._commit)
            raise FileFormatError(
                f"{self._reference}: found {STATE} with sha256 {found}, expected {record.sha256 or 'one'} as in "
                f"{DESCRIPTION}: it is damaged or of another model; delete {kept} to fetch it again"
            )
        self._keep(STATE, data)

    def _read(self, file: str, size: int, exactly: bool = False) -> bytes:
        """A file's content, fetched where its size is what it may be."""
        self._check_size(file, self._ask(file, self._commit, dry_run=True).file_size, size, exactly)
        with Path(self._ask(file, self._commit)).open("rb") as opened:
            return opened.read(size + 1)

    def _check_size(self, file: str, found: int | None, size: int, exactly: bool = False) -> None:
        if found is None or found > size or (exactly and found != size):
            expected = f"{'' if exactly else 'at most '}{size}"
            raise FileFormatError(f"{self._reference}: found {file} of {found} bytes, expected {expected}")

    def _keep(self, file: str, data: bytes) -> None:
        if not (self.folder / file).is_file():
            with made_folder(self.folder):
                write_file(self.folder / file, data)

    def _ask(self, file: str, revision: str, dry_run: bool = False) -> Any:
        """A file's path in the package's cache, or only what is known of it."""
        errors, reference = self._errors, self._reference
        try:
            return self._hub.hf_hub_download(
                reference.repository,
                file,
                subfolder=reference.folder or None,
                revision=revision,
                endpoint=os.environ.get("HF_ENDPOINT"),
                library_name="torchface",
                dry_run=dry_run,
            )
        except errors.GatedRepoError as error:
            raise NameMismatchError(
                f"{reference}: found a repository whose owner asks for consent, expected one that is shown to you: "
                "agree on its page, then `hf auth login`"
            ) from error
        except errors.RepositoryNotFoundError as error:
            raise NameMismatchError(
                f"{reference}: found no such repository, expected one that is public or shown to you (`hf auth login`)"
            ) from error
        except errors.RevisionNotFoundError as error:
            raise NameMismatchError(
                f"{reference}: found no such revision, expected a branch, tag or commit of {reference.repository}"
            ) from error
        except errors.LocalEntryNotFoundError as error:  # is an EntryNotFoundError too
            raise FileFormatError(
                f"{reference}: cannot be reached, and {file} was not fetched before ({_first_line(error)}); "
                "expected a connection, or what an earlier run has fetched"
            ) from error
        except errors.EntryNotFoundError as error:
            raise _MissingFileError(f"{reference}: found no {file}, {_LAYOUT}") from error
        except (errors.HTTPError, OSError, ValueError, RuntimeError) as error:
            raise FileFormatError(f"{reference}: {file} cannot be fetched ({_first_line(error)})") from error


class _MissingFileError(FileFormatError):
    """The repository has no such file."""


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
