"""The facts of a run on the first page: specimen, site, operator, protocol, state."""

from __future__ import annotations

from collections.abc import Iterator

from service.audit.overview.shots import failed_exposures, shots_by_step, together
from service.audit.record.missing_results import not_in_yet
from service.audit.record.run import RecordedRun
from service.audit.report.blocks import DescriptionList, TableCell
from service.audit.report.sections.notes import about_facts
from service.audit.report.words import duration, utc
from service.core.errors import OrthocaptureError
from service.core.records.events import SessionStarted
from service.dataset.registrations import late_results
from service.rig import parse_recorded_rig


def facts(run: RecordedRun) -> DescriptionList:
    """Names and values for the first page."""
    root, state, events = run.root, run.state, run.events
    shots = shots_by_step(run.protocol, state, failed_exposures(events))
    others = sorted(run.named(person) for person in state.people - {root.operator})
    status = {"active": "not finished"}.get(state.status, state.status)
    return DescriptionList(
        (
            *_of_what_and_where(run),
            ("Run", run.run_id),
            ("Begun", utc(events[0].at_utc)),
            ("Last record", f"{utc(events[-1].at_utc)}, after {duration(events[0].at_utc, events[-1].at_utc)}"),
            (
                "State",
                TableCell(
                    status + (f": {state.stop_reason}" if state.stop_reason else ""),
                    "ok" if status == "completed" else "attention",
                ),
            ),
            ("Begun by", run.named(root.operator)),
            ("Others who took part", ", ".join(others) or "none"),
            ("Released by", run.named(state.released_by) if state.released_by else "nobody"),
            ("Protocol", f"{root.protocol_id}, version {root.protocol_version}"),
            ("SHA-256 of the protocol", root.protocol_sha256),
            (
                "SHA-256 of the list of imported files"
                if root.origin == "imported"
                else "SHA-256 of the rig's description",
                root.rig.sha256,
            ),
            *_later(run),
            ("Photographs", together(shots).words),
            ("Records", str(len(events))),
            ("Chain head", events[-1].sha256),
        )
    )


def _of_what_and_where(run: RecordedRun) -> Iterator[tuple[str, TableCell | str]]:
    """Specimen, site and purpose as entered, the rig, and the machine that drove the run."""
    entered = about_facts(run)
    names = {name for name, _ in entered}
    if "Specimen" not in names:
        yield "Specimen", "not recorded"
    yield from entered
    if "Site" not in names:
        yield "Site", "not recorded"
    hosts = list(dict.fromkeys(e.payload.host for e in run.events if isinstance(e.payload, SessionStarted)))
    at = f", driven from the machine {', '.join(hosts)}" if hosts else ""
    name = _rig_name(run)
    yield "Rig", f"{name}{at}" if name else f"not recorded{at}"


def _rig_name(run: RecordedRun) -> str:
    """The name in the rig file; "" for imported photographs, or if the file is missing or altered."""
    if run.root.origin == "imported":
        return ""
    try:
        path = run.files.artefact_path(run.root.rig.sha256, verify=True)
        return parse_recorded_rig(path.read_bytes(), path).section.name
    except (OrthocaptureError, OSError):
        return ""  # the first page names the file


def _later(run: RecordedRun) -> Iterator[tuple[str, TableCell]]:
    late = late_results(run.protocol, run.state)
    if late:
        yield "Results that arrived after the evaluation", TableCell(", ".join(one.name for one in late), "attention")
    missing = not_in_yet(run.protocol, run.state, run.events)
    if missing:
        yield "Results not in yet", TableCell("; ".join(missing), "attention")
