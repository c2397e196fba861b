"""Caches a worker's answers to jobs: an answer is a pure function of the job's arguments.

A sweep repeats the same jobs a thousand times. If the arguments are bitwise equal, the files of the first answer are
stored again through the same calls; if anything differs, the job is computed.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from service.computations.job import ArtefactStore, Handler, JobAnswer, RecordedContext
from service.core.records.base import ArtefactRef
from service.store.events import canonical


@dataclass
class _Recording:
    """An ArtefactStore that records what was stored."""

    store: ArtefactStore
    put: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        return self.store.artefact_path(sha256, verify=verify)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        self.put.append({"data": data, "kind": kind, "media_type": media_type, "original_name": original_name})
        return self.store.put_bytes(data, kind=kind, media_type=media_type, original_name=original_name)

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        return self.put_bytes(path.read_bytes(), kind=kind, media_type=media_type, original_name=original_name)


def remembering(handlers: Mapping[str, Handler], folder: Path) -> dict[str, Handler]:
    """Wrap the handlers so that they keep their answers in a folder."""
    folder.mkdir(exist_ok=True)
    return {kind: _remembering(kind, handler, folder) for kind, handler in handlers.items()}


def _remembering(kind: str, handler: Handler, folder: Path) -> Handler:
    def handle(context: RecordedContext) -> JobAnswer:
        named = canonical({"kind": kind, "arguments": dict(context.arguments)})
        known = folder / hashlib.sha256(named.encode()).hexdigest()
        if known.exists():
            puts, answer = pickle.loads(known.read_bytes())  # written below by this program
            for put in puts:
                context.store.put_bytes(**put)
            return answer
        recording = _Recording(context.store)
        answer = handler(replace(context, store=recording))
        part = known.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps((recording.put, answer)))
        part.replace(known)
        return answer

    return handle
