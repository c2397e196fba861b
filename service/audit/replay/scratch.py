"""A store for recomputed jobs: reads the evidence, and writes into a folder of its own."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

from service.audit.record.run import RecordedFiles
from service.core.records.events import ArtefactRef
from service.store.artefacts import hash_file


class ScratchStore:
    """The store that a job's handler sees during a replay."""

    def __init__(self, recorded: RecordedFiles, folder: Path) -> None:
        self._recorded = recorded
        self._folder = folder

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """A recomputed file, or else the recorded one. Raises IntegrityError."""
        own = self._folder / sha256
        return own if own.is_file() else self._recorded.artefact_path(sha256, verify=verify)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep bytes in the scratch folder."""
        digest = hashlib.sha256(data).hexdigest()
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / digest).write_bytes(data)
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=len(data), original_name=original_name
        )

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep a copy of a file in the scratch folder."""
        digest, size = hash_file(path)
        self._folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, self._folder / digest)
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=size, original_name=original_name
        )
