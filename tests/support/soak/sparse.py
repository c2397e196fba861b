"""Sparse photographs: long files that occupy no space, kept by a store that preserves their holes."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from service.store.durable_effects import DurableFiles

_BLOCK_BYTES = 16384
_ZEROS = bytes(_BLOCK_BYTES)


class SparseFiles(DurableFiles):
    """The store's file operations, except that zeros are not written, so that the file system stores holes.

    All bytes still pass through the store and are hashed. While `unhurried`, files and folders are synced too;
    otherwise only the database is.
    """

    unhurried = True

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Write a file, leaving holes instead of zeros."""
        flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW
        with open(os.open(path, flags, 0o600 if private else 0o666), "wb", buffering=0) as handle:
            for chunk in chunks:
                for start in range(0, len(chunk), _BLOCK_BYTES):
                    block = chunk[start : start + _BLOCK_BYTES]
                    if block == _ZEROS[: len(block)]:
                        handle.seek(len(block), os.SEEK_CUR)
                    else:
                        handle.write(block)
            handle.truncate(handle.tell())

    def sync_file(self, path: Path) -> None:
        """Sync a file while `unhurried`; otherwise do nothing."""
        if self.unhurried:
            super().sync_file(path)

    def sync_directory(self, path: Path) -> None:
        """Sync a folder while `unhurried`; otherwise do nothing."""
        if self.unhurried:
            super().sync_directory(path)


def sparse_photograph(path: Path, number: int, size_bytes: int) -> None:
    """Write a JPEG that shows its number, followed by a hole up to `size_bytes`."""
    picture = np.full((120, 180, 3), 40 + number % 200, dtype=np.uint8)
    cv2.putText(picture, str(number), (8, 70), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (255, 255, 255), 2)
    done, encoded = cv2.imencode(".jpg", picture)
    assert done
    with path.open("wb") as handle:
        handle.write(encoded.tobytes())
        handle.truncate(max(size_bytes, len(encoded)))
