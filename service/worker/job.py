"""What a job handler is given and gives back."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from service.compute.camera_model import CameraModel
from service.core.records.events import ArtefactRef


class ArtefactStore(Protocol):
    """What a job needs of the store; a replay gives it one that reads the evidence and writes elsewhere."""

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """The read-only file of an artefact. Raises IntegrityError when missing or, with `verify`, altered."""
        ...

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep bytes; the reference to them."""
        ...


@dataclass(frozen=True, slots=True)
class JobAnswer:
    """Numbers, files (already in the store) and plain data."""

    measures: Mapping[str, float]
    artefacts: tuple[ArtefactRef, ...] = ()
    result: Mapping[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True, slots=True)
class JobContext:
    """What a handler may touch: its arguments, verified inputs, a scratch folder and the store for its outputs."""

    arguments: Mapping[str, Any]
    store: ArtefactStore
    scratch: Path
    progress: Callable[[str, int, int], None]

    def input(self, sha256: str) -> Path:
        """An artefact's file, its hash verified."""
        return self.store.artefact_path(sha256, verify=True)

    def input_json(self, sha256: str) -> Any:
        """An artefact's JSON content."""
        return json.loads(self.input(sha256).read_bytes())

    def keep_json(self, data: Any, *, kind: str, name: str) -> ArtefactRef:
        """Write a JSON artefact."""
        text = json.dumps(data, indent=1, sort_keys=True).encode()
        return self.store.put_bytes(text, kind=kind, media_type="application/json", original_name=name)

    def keep_bytes(self, data: bytes, *, kind: str, media_type: str, name: str) -> ArtefactRef:
        """Write any artefact."""
        return self.store.put_bytes(data, kind=kind, media_type=media_type, original_name=name)

    def camera(self) -> CameraModel:
        """The job's camera."""
        return CameraModel.from_record(self.arguments["camera"])


Handler = Callable[[JobContext], JobAnswer]
