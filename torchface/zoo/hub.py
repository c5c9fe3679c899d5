"""Models of Hugging Face repositories in the layout of a model's folder; nothing else of a repository is fetched."""

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.cache_folder import cache_folder
from torchface.files.extra_packages import import_extra
from torchface.files.models import CARD, DESCRIPTION, MAX_CARD_BYTES, STATE, check_claims
from torchface.zoo.kinds import KINDS

_MAX_DESCRIPTION_BYTES = 2**18
_PART = r"[A-Za-z0-9][\w.-]{0,95}"
_REFERENCE = re.compile(rf"hf:/{{1,2}}({_PART}/{_PART})(?:@({_PART}))?((?:/{_PART})*)", re.ASCII)
_EXPECTED = "expected hf://OWNER/NAME, hf://OWNER/NAME@REVISION or hf://OWNER/NAME/FOLDER"
_LAYOUT = f"expected a model's folder as zoo.save_model writes it, {DESCRIPTION}, {STATE} and {CARD}"


@dataclass(frozen=True)
class HubReference:
    """A model's folder in a repository of the Hugging Face Hub."""

    repository: str  # owner/name
    revision: str  # a branch, tag or commit
    folder: str  # of the model in the repository; empty for the repository's own

    def __str__(self) -> str:
        return f"hf://{self.repository}@{self.revision}{'/' if self.folder else ''}{self.folder}"

    @property
    def name(self) -> str:
        """Of the model: its folder's, or the repository's."""
        return (self.folder or self.repository).rpartition("/")[2]


def hub_reference(text: str) -> HubReference | None:
    """What ``hf://owner/name[@revision][/folder]`` says; None where the text is of no such kind."""
    if not text.startswith("hf:/"):
        return None
    match = _REFERENCE.fullmatch(text)
    if match is None:
        raise NameMismatchError(f"model: found {text[:200]!r}, {_EXPECTED}")
    return HubReference(match[1], match[2] or "main", match[3].strip("/"))


def fetch_description(reference: HubReference) -> Path:
    """A folder on this machine with a repository's ``model.toml`` and ``CARD.md``."""
    folder = _fetched(reference, DESCRIPTION, _MAX_DESCRIPTION_BYTES).parent
    _fetch_card(reference)
    return folder


def fetch_model(reference: HubReference) -> Path:
    """A folder on this machine with a repository's model: its description, card and state.

    The description is read first. The state is fetched only where its kind is known and its size is what the
    description says and no more than the config asks for; whoever loads it checks its hash.
    """
    folder = _fetched(reference, DESCRIPTION, _MAX_DESCRIPTION_BYTES).parent
    record = check_claims(folder, KINDS)
    _fetch_card(reference)
    _fetched(reference, STATE, record.size, exactly=True)
    return folder


def _fetch_card(reference: HubReference) -> None:
    """Fetches the card, if there is one."""
    with suppress(_MissingFileError):
        _fetched(reference, CARD, MAX_CARD_BYTES)


def _fetched(reference: HubReference, file: str, size: int, exactly: bool = False) -> Path:
    """A file of a model as a plain file on this machine, fetched where it is not there and has ``size`` bytes at
    most or exactly."""
    owner, _, name = reference.repository.partition("/")
    # The package's own cache holds links, which a model's folder may not have.
    folder = cache_folder("hub") / owner / name / reference.revision
    bytes_there = _ask(reference, file, folder, dry_run=True).file_size
    if bytes_there is None or bytes_there > size or (exactly and bytes_there != size):
        expected = f"{'' if exactly else 'at most '}{size}"
        raise FileFormatError(f"{reference}: found {file} of {bytes_there} bytes, expected {expected}")
    return Path(_ask(reference, file, folder))


def _ask(reference: HubReference, file: str, folder: Path, dry_run: bool = False) -> Any:
    """A file's path below the folder, or only what is known of it."""
    hub = import_extra("huggingface_hub", "huggingface_hub", "hub", str(reference))
    errors = import_extra("huggingface_hub.errors", "huggingface_hub", "hub", str(reference))
    try:
        return hub.hf_hub_download(
            reference.repository,
            file,
            subfolder=reference.folder or None,
            revision=reference.revision,
            endpoint=os.environ.get("HF_ENDPOINT"),
            library_name="torchface",
            local_dir=folder,
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
