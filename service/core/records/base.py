"""The frozen base class of all records, and the reference to a content-addressed file."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict


class Record(BaseModel):
    """Base of everything that is written down: frozen, no unknown fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


def recorded(record: Record) -> dict[str, Any]:
    """A record as it is written into an event: all of its own fields; of the records in it, the fields that were set.

    So a part that was read from an earlier event is written again exactly as it was.
    """
    return record.model_dump(mode="json") | record.model_dump(mode="json", exclude_unset=True)


class ArtefactRef(Record):
    """A reference to a content-addressed file, as events hold it."""

    sha256: str
    kind: str  # image, raw, board_image, scan, ct_slice, ct_mesh, pose_log, result, report, protocol, rig …
    media_type: str
    size_bytes: int
    original_name: str
