"""Recomputed results in place of recorded ones: for a replay from end to end, and the drift at its end."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from service.compute.evaluation.accuracy import true_error_m
from service.core.geometry import apply
from service.core.run.state import JobState
from service.core.units import mm
from service.dataset.summary import RunSummary
from service.worker.job import JobAnswer

_TELLING_DIGITS = 12  # a number of so many digits is found again by its value: nobody typed it


@dataclass(frozen=True, slots=True)
class Drift:
    """How far the scan lies from where the recorded registration put it, at the centre of its spheres."""

    registration: str
    in_world_mm: float | None  # by T_world_scan; None where the world frame is the reconstruction's own
    against_cameras_mm: float  # the cameras being laid over one another


class Recomputed:
    """What jobs gave again, found by what they had given when it was recorded.

    Later jobs hold earlier results by value (a camera, centres of spheres) and files by hash. Both are told by their
    content: a part of the arguments that is bit for bit a part of an earlier result came from there.
    """

    def __init__(self) -> None:
        self.renamed: dict[str, str] = {}
        self.results: dict[str, tuple[Any, Any]] = {}  # job → payload as recorded, as recomputed
        self._parts: dict[str, Any] = {}
        self._steps: dict[str, str] = {}

    def add(self, job: JobState, recorded: Mapping[str, Any], now: Mapping[str, Any], answer: JobAnswer) -> None:
        """Note a job computed again, after those that it follows."""
        self.results[job.job] = (recorded, now)
        self._steps[job.job] = str(recorded["step"])
        for old, new in zip(recorded["artefacts"], answer.artefacts, strict=False):
            if old["sha256"] != new.sha256:
                self.renamed[old["sha256"]] = new.sha256
        self._index(recorded["result"], now["result"])

    def _index(self, old: Any, new: Any) -> None:
        if _is_telling(old):
            self._parts[_key(old)] = new
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            here, there = cast("Mapping[str, Any]", old), cast("Mapping[str, Any]", new)
            for key in here.keys() & there.keys():
                self._index(here[key], there[key])
        elif isinstance(old, list) and isinstance(new, list) and len(cast("list[Any]", old)) == len(new):
            for a, b in zip(cast("list[Any]", old), cast("list[Any]", new), strict=True):
                self._index(a, b)

    def in_place_of_recorded(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """A job's arguments with all that came from earlier jobs replaced by what they gave now."""
        return {key: self._replaced(value) for key, value in arguments.items()}

    def _replaced(self, value: Any) -> Any:
        if isinstance(value, str):
            return self.renamed.get(value, value)
        if _is_telling(value):
            found = self._parts.get(_key(value), self)
            if found is not self:
                return self._with_new_hashes(found)
        if isinstance(value, Mapping):
            return {key: self._replaced(item) for key, item in cast("Mapping[str, Any]", value).items()}
        if isinstance(value, list | tuple):
            return [self._replaced(item) for item in cast("Sequence[Any]", value)]
        return value

    def _with_new_hashes(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: self._with_new_hashes(item) for key, item in cast("Mapping[str, Any]", value).items()}
        if isinstance(value, list):
            return [self._with_new_hashes(item) for item in cast("list[Any]", value)]
        return self.renamed.get(value, value) if isinstance(value, str) else value

    def measures_of(self, step: str, recorded: Mapping[str, float]) -> dict[str, float] | None:
        """A step's measures with those of its jobs replaced; None where no job of it was computed again.

        A step may put a source before the name of a job's measure (colmap_rms_px): name's end and value tell.
        """
        jobs = [pair for job, pair in self.results.items() if self._steps[job] == step]
        if not jobs:
            return None
        measures = dict(recorded)
        for old, new in jobs:
            for name, value in old["measures"].items():
                for own in measures:
                    if own.endswith(name) and recorded[own] == value and name in new["measures"]:
                        measures[own] = float(new["measures"][name])
        return measures


def drifts(summary: RunSummary, recomputed: Recomputed) -> Iterator[Drift]:
    """For every registration that was computed again."""
    spheres = summary.result("scan_import").get("spheres_m")
    if not spheres:
        return
    centre_m = np.array(spheres, dtype=np.float64).mean(axis=0)
    for old, new in recomputed.results.values():
        if old["job_kind"] != "register":
            continue
        before, after = old["result"], new["result"]
        shared = sorted(before["T_scan_camera"].keys() & after["T_scan_camera"].keys())
        moved, given = (np.array([each["T_scan_camera"][name] for name in shared]) for each in (after, before))
        in_world: float | None = None
        if before["poses"] in ("robot", "robot_corrected"):  # the world is the base of the first station
            places = [apply(np.array(each["T_world_scan"]), centre_m) for each in (before, after)]
            in_world = mm(float(np.linalg.norm(places[1] - places[0])))
        yield Drift(str(before["poses"]), in_world, mm(true_error_m(moved, given, centre_m)))


def _key(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _is_telling(value: Any) -> bool:
    """Whether this holds a number that can be told from every other."""
    if isinstance(value, float):
        return len(repr(value).split("e")[0].replace("-", "").replace(".", "").strip("0")) >= _TELLING_DIGITS
    if isinstance(value, Mapping):
        return any(map(_is_telling, cast("Mapping[str, Any]", value).values()))
    return isinstance(value, list | tuple) and any(map(_is_telling, cast("Sequence[Any]", value)))
