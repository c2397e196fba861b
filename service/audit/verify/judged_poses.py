"""Says which views the verification cannot judge by their joints, and why: silence would read as a verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.errors import StoreError
from service.core.recorded_devices import recorded_report
from service.core.records.events import DeviceOpened, Event, ViewpointCaptured
from service.core.text.words import counted
from service.store.database.opening import open_read_only
from service.store.durable_effects import DurableFiles
from service.store.events import read_events
from service.store.verification.verify import AuditReport, verify

if TYPE_CHECKING:
    from collections.abc import Sequence

    from service.store.verification.file_checks import Progress


_NOT_COMPARED = " are not compared, because "


def limits(notes: Sequence[str]) -> list[str]:
    """Return those of a verification's notes that say what it could not judge."""
    return [note for note in notes if _NOT_COMPARED in note]


def verify_with_limits(
    data_dir: Path,
    run_id: str | None = None,
    progress: Progress | None = None,
    *,
    certificates: Path | None = None,
    files: bool = True,
    signatures_copy: Path | None = None,
    stated_hashes: bool = False,
) -> AuditReport:
    """Verify as `verify` does, and note how many views are not judged. A record with faults is not read for that.

    Raises:
        UnknownRunError: there is no such run.
        StoreError: there is no database, or it cannot be read.
    """
    report = verify(
        data_dir,
        run_id,
        progress,
        certificates=certificates,
        files=files,
        signatures_copy=signatures_copy,
        stated_hashes=stated_hashes,
    )
    if not report.ok:
        return report
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            notes = [f"{run}: {text}" for run in report.runs for text in not_judged(read_events(connection, run, 0))]
    except StoreError as error:  # recorded by a newer version, or altered this moment
        notes = [f"whether poses fit their joints was not looked at: {error}"]
    finally:
        database.close()
    return replace(report, notes=(*report.notes, *notes))


def not_judged(events: Iterable[Event]) -> list[str]:
    """Return a sentence for each reason for which views are not judged, with their number."""
    arms: dict[str, tuple[str, str, int]] = {}  # device → model, why it is not judged or "", number of its joints
    counts: Counter[str] = Counter()
    for event in events:
        payload = event.payload
        if isinstance(payload, DeviceOpened):
            identity = recorded_report(payload.report).identity
            if identity.kind == "robot":
                arms[payload.device] = _arm(identity.model)
        elif isinstance(payload, ViewpointCaptured):
            counts.update(_reasons(arms, len(payload.joints_rad)))
    return [
        f"pose and joints of {counted(number, 'view')}{_NOT_COMPARED}{reason}" for reason, number in counts.items()
    ]


def _arm(model: str) -> tuple[str, str, int]:
    from service.core.arms.model import known_arm  # noqa: PLC0415 - searches for plug-ins

    arm = known_arm(model)
    if arm is None:
        return model, f"no kinematics are known for an arm {model!r}", 0
    if arm.family != "universal_robot":
        return model, f"the controller of an arm {model} reports the flange, whatever its tool", arm.axes
    return model, "", arm.axes


def _reasons(arms: dict[str, tuple[str, str, int]], joints: int) -> Iterator[str]:
    """Yield the one reason why a view is not judged; nothing for a view that is."""
    why = next((reason for _, reason, _ in arms.values() if reason), "")
    if not arms:
        yield "the record names no arm that was connected before"
    elif why:
        yield why
    elif not any(axes == joints for _, _, axes in arms.values()):
        models = " and ".join(dict.fromkeys(model for model, _, _ in arms.values()))
        yield f"an arm {models} has not the {joints} joints that were recorded"
