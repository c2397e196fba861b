"""What the store needs of an object store: a narrow interface, and the errors that every adapter raises."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from service.core.errors import StoreError


class ObjectStoreError(StoreError):
    """An object store refused a request: keys, rights, name of the bucket. To try again helps only after a change."""


class ObjectStoreAwayError(ObjectStoreError):
    """An object store does not answer, or answers that it cannot now; to try again later helps."""


@dataclass(frozen=True, slots=True)
class StoredObject:
    """The statement of an object store about one object.

    Attributes:
        size_bytes: its size.
        sha256: the SHA-256 that the store computed when the object arrived; "" if it states none.
    """

    size_bytes: int
    sha256: str


class ObjectStore(Protocol):
    """Objects named by the SHA-256 of their content. Every method raises ObjectStoreError."""

    @property
    def place(self) -> str:
        """The name of the place in records and messages, without keys."""
        ...

    def require_bucket(self) -> None:
        """Raise ObjectStoreError, with its name, if there is no such bucket: some stores make one at a first put."""
        ...

    def put_if_absent(self, sha256: str, path: Path) -> bool:
        """Store a file unless an object of this name exists, whatever it holds. Returns whether it was stored.

        Raises IntegrityError if the file does not have this hash, StoreError if it cannot be read.
        """
        ...

    def stat(self, sha256: str) -> StoredObject | None:
        """Return what the store states about an object now; None if it has none of this name."""
        ...

    def chunks(self, sha256: str) -> Iterator[bytes]:
        """Yield the content of an object as it arrives; nothing is checked. An object that is missing is refused."""
        ...

    def fetch(self, sha256: str, to: Path) -> int:
        """Write an object into a new file, hashing it on the way. Returns its size in bytes.

        Raises IntegrityError, and leaves no file, if its content is not that of its name.
        """
        ...

    def list(self) -> Iterator[tuple[str, int]]:
        """Yield name and size in bytes of every object that is named by a hash."""
        ...

    def delete(self, sha256: str) -> None:
        """Delete an object, if it exists and the store lets it be deleted."""
        ...
