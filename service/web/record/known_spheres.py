"""Which spheres a run knows by now, in which frame, and which of them take no part in the registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points, apply
from service.dataset.registrations import best_registration as best_registration_name
from service.dataset.registrations import registrations
from service.jobs.registration.register import Registration
from service.run_record import RunRecord

SphereKind = Literal["registration", "control", "sphere"]


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere by the number that pages and pictures give it."""

    label: str  # "3"; "C1" for a control sphere
    kind: SphereKind  # "sphere": not known yet whether it will stay for the registration
    centre_m: tuple[float, float, float]
    rms_mm: float | None = None  # of the surface points against the fitted sphere
    radius_residual_mm: float | None = None


@dataclass(frozen=True, slots=True)
class ShownRegistration:
    """The registration that pages show: see service.dataset.registrations.best_registration."""

    name: str
    record: Registration
    step: str


def result_of_kind(log: RunRecord, kind: str) -> tuple[str, Mapping[str, Any]]:
    """Name and result of the last step of a kind that has one; "" and nothing if there is none."""
    for step in reversed(log.protocol.steps):
        result = log.state.steps[step.id].result
        if step.kind == kind and result:
            return step.id, result
    return "", {}


def best_registration(log: RunRecord) -> ShownRegistration | None:
    """None before there is one."""
    step, _ = result_of_kind(log, "registration")
    name = best_registration_name(log.protocol, log.state)
    return None if name is None else ShownRegistration(name, registrations(log.protocol, log.state)[name], step)


def scan_spheres(log: RunRecord, by: ShownRegistration) -> tuple[Sphere, ...]:
    """Spheres of the registered scan, and the control spheres, in its frame."""
    params = log.protocol.step(by.step).params.model_dump()
    scan = log.state.steps[params["scan"]].result if params["scan"] in log.state.steps else {}
    if not scan:
        return ()
    evaluation = next((s for s in reversed(log.protocol.steps) if s.kind == "evaluation"), None)
    before = None if evaluation is None else evaluation.params.model_dump().get("control_scan")
    control: Mapping[str, Any] = {} if before is None else log.state.steps[before].result
    extra = _control_centres(_key(scan["spheres_m"]), _key(control.get("spheres_m", ())))
    return (*_numbered(scan, "registration"), *(Sphere(f"C{i}", "control", c) for i, c in enumerate(extra)))


def ct_spheres(log: RunRecord) -> tuple[Sphere, ...]:
    """Spheres of the CT, in its frame; all of them, for it does not say which are taken away later."""
    return _numbered(result_of_kind(log, "ct_import")[1], "sphere")


def _numbered(result: Mapping[str, Any], kind: SphereKind) -> tuple[Sphere, ...]:
    details: Mapping[str, Any] = result.get("details", {})
    records = details.get("spheres", [{}] * len(result.get("spheres_m", ())))
    return tuple(
        Sphere(str(i), kind, _point(centre), record.get("rms_mm"), record.get("radius_residual_mm"))
        for i, (centre, record) in enumerate(zip(result.get("spheres_m", ()), records, strict=False))
    )


def _point(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _key(centres: Any) -> tuple[tuple[float, float, float], ...]:
    return tuple(_point(c) for c in centres)


Points = tuple[tuple[float, float, float], ...]


@lru_cache(maxsize=16)
def _control_centres(scan: Points, control: Points) -> Points:
    """What the control scan shows beside the spheres of the scan, in the scan's frame."""
    if not scan or not control:
        return ()
    a, b = np.array(scan), np.array(control)
    try:
        found = match_constellations(a, b)
    except ComputeError:
        return ()
    pairs = np.array(found.pairs)
    T_a_b, _ = align_points(a[pairs[:, 0]], b[pairs[:, 1]])
    extra: Array = apply(T_a_b, b[list(found.missing_b)]) if found.missing_b else np.zeros((0, 3))
    return _key(extra)
