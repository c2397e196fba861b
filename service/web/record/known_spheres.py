"""The spheres known in a run so far, in which frame, and which of them are not used in the registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.core.protocol.step_params import Gives
from service.dataset.registrations import best_registration, registrations
from service.dataset.summary import control_centres, control_scan, registered_scan
from service.jobs.records import SpheresFound
from service.jobs.registration.register import Registration
from service.jobs.surfaces import locate_spheres
from service.run_record import RunRecord

SphereKind = Literal["registration", "control", "sphere"]


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere with the label that pages and pictures show."""

    label: str  # "3"; "C1" for a control sphere
    kind: SphereKind  # "sphere": not known yet whether it is a registration or a control sphere
    centre_m: tuple[float, float, float]
    rms_mm: float | None = None  # of the surface points against the fitted sphere
    radius_residual_mm: float | None = None


@dataclass(frozen=True, slots=True)
class DisplayedRegistration:
    """The registration that pages show: see service.dataset.registrations.best_registration."""

    name: str
    record: Registration
    step: str


def last_step(log: RunRecord, gives: Gives) -> str:
    """The last step that gives this and has a result; "" if there is none."""
    steps = (step.id for step in reversed(log.protocol.steps) if step.gives == gives)
    return next((step for step in steps if log.state.steps[step].result), "")


def displayed_registration(log: RunRecord) -> DisplayedRegistration | None:
    """The registration to show; None before there is one."""
    name = best_registration(log.protocol, log.state)
    if name is None:
        return None
    record = registrations(log.protocol, log.state)[name]
    return DisplayedRegistration(name, record, last_step(log, "registrations"))


def scan_spheres(log: RunRecord) -> tuple[Sphere, ...]:
    """Spheres of the registered scan, and the control spheres, in its frame."""
    scan = _found_in(log, registered_scan(log.protocol, log.state))
    if not scan.spheres_m:
        return ()
    before = control_scan(log.protocol)
    control = _found_in(log, before) if before else SpheresFound(spheres_m=())
    extra = control_centres(scan.spheres_m, control.spheres_m)
    return (*_numbered(scan, "registration"), *(Sphere(f"C{i}", "control", c) for i, c in enumerate(extra)))


def ct_spheres(log: RunRecord) -> tuple[Sphere, ...]:
    """All spheres of the CT, in its frame; the CT does not show which of them are removed later."""
    return _numbered(_found_in(log, last_step(log, "ct_surface")), "sphere")


def _found_in(log: RunRecord, step: str) -> SpheresFound:
    """What a step that imports a scan or a CT found; no spheres without such a step, or before it has a result."""
    result = log.state.steps[step].result if step in log.state.steps else {}
    return locate_spheres.KIND.read_answer(result) if result else SpheresFound(spheres_m=())


def _numbered(found: SpheresFound, kind: SphereKind) -> tuple[Sphere, ...]:
    measured = found.details.spheres or (None,) * len(found.spheres_m)
    return tuple(
        Sphere(str(i), kind, centre)
        if sphere is None
        else Sphere(str(i), kind, centre, sphere.rms_mm, sphere.radius_residual_mm)
        for i, (centre, sphere) in enumerate(zip(found.spheres_m, measured, strict=False))
    )
