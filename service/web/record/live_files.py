"""The files in which jobs keep outlines and provisional poses of images, read as typed records."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from pydantic import BaseModel, ConfigDict, TypeAdapter

from service.jobs.records import Matrix

OutlineRecord = dict[str, object]  # as service.compute.markers.records writes it
_OUTLINES_BY_VIEWPOINT = TypeAdapter(dict[str, tuple[OutlineRecord, ...]])


class LivePose(BaseModel):
    """Where an image was taken, as the job `live_view` found it; T_base_scan is None while it is not known."""

    model_config = ConfigDict(frozen=True)

    station: str
    T_base_camera: Matrix
    T_base_scan: Matrix | None


class LiveOutlines(LivePose):
    """Add the outlines of the spheres that the job found in the image."""

    outlines: tuple[OutlineRecord, ...]


@lru_cache(maxsize=512)
def read_live_pose(path: Path) -> LivePose:
    """The pose in a file of a job `live_view`; cached, because an artefact never changes under its name."""
    return LivePose.model_validate_json(path.read_bytes())


@lru_cache(maxsize=8)
def read_live_outlines(path: Path) -> LiveOutlines:
    """A file of a job `live_view`, with its outlines."""
    return LiveOutlines.model_validate_json(path.read_bytes())


@lru_cache(maxsize=8)
def read_outlines(path: Path) -> Mapping[str, tuple[OutlineRecord, ...]]:
    """A file of a job `detect_spheres`: the outlines in each image, by viewpoint."""
    return _OUTLINES_BY_VIEWPOINT.validate_json(path.read_bytes())
