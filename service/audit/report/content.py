"""The content of a report, made from a run's evidence, from the facts of its first page on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime

from service.audit.overview.digest import failed_exposures, shots_by_step, together
from service.audit.record.run import RecordedRun, not_in_yet
from service.audit.report.accuracy import (
    accuracy_section,
    budget_section,
    further_cameras_section,
    later_section,
    result_sentence,
)
from service.audit.report.blocks import DescriptionList, Paragraph, Report, Section, TableCell, duration, utc
from service.audit.report.certificates import certificate_sections
from service.audit.report.course import (
    NotableEvent,
    deviations,
    deviations_section,
    no_deviation,
    people_section,
    steps_section,
)
from service.audit.report.origin import devices_section, software_section, verification_section
from service.audit.report.photographs import about_facts, notes_section, pictures_section
from service.core.errors import OrthocaptureError
from service.core.records.import_list import imported_sentence
from service.core.records.run_events import SessionStarted
from service.core.words import counted
from service.dataset.registrations import late_results
from service.rig import parse_recorded_rig
from service.store.verification.verify import AuditReport


def facts(run: RecordedRun) -> DescriptionList:
    """Return names and values for the first page."""
    root, state, events = run.root, run.state, run.events
    shots = shots_by_step(run.protocol, state, failed_exposures(events))
    others = sorted(run.named(person) for person in state.people - {root.operator})
    status = {"active": "not finished"}.get(state.status, state.status)
    return DescriptionList(
        (
            *_of_what_and_where(run),
            ("Run", run.run_id),
            ("Started", utc(events[0].at_utc)),
            ("Last record", f"{utc(events[-1].at_utc)}, after {duration(events[0].at_utc, events[-1].at_utc)}"),
            (
                "State",
                TableCell(
                    status + (f": {state.stop_reason}" if state.stop_reason else ""),
                    "ok" if status == "completed" else "attention",
                ),
            ),
            ("Started by", run.named(root.operator)),
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
    """Yield the specimen, site and purpose as entered, the rig, and the machine that drove the run."""
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
    """Return the name in the rig file; "" for imported photographs, or if the file is missing or altered."""
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


def report_content(
    run: RecordedRun,
    audit: AuditReport,
    *,
    made_at: datetime | None = None,
    true_error_mm: Mapping[str, float] | None = None,
    with_scene: bool = True,
    with_pictures: bool = True,
) -> Report:
    """Return the report of a run.

    Args:
        run: the run.
        audit: the result of the verification, which is shown on the first page.
        made_at: the time stamp of the report, default: now. The same evidence and time stamp give the same report.
        true_error_mm: the true error by source of poses, which only a simulated rig knows; it is marked as such.
        with_scene: include the scene that can be turned, which only HTML can show; its drawing is always included.
        with_pictures: False leaves out everything that shows photographs.
    """
    listed = deviations(run)
    sections = _sections(run, audit, listed, true_error_mm, with_scene=with_scene, with_pictures=with_pictures)
    return Report(
        title=run.protocol.title,
        simulated=run.root.simulated,
        origin=_origin(run),
        verification=_verification(audit),
        result=result_sentence(run.summary()),
        deviations=TableCell(f"{counted(len(listed), 'deviation')}, listed first", "attention")
        if listed
        else no_deviation(run),
        release=_release(run),
        facts=facts(run),
        sections=tuple(section for section in sections if section is not None),
        run_id=run.run_id,
        head_sha256=run.events[-1].sha256,
        made_at=(made_at or datetime.now(UTC)).astimezone(UTC).replace(microsecond=0),
    )


def _sections(
    run: RecordedRun,
    audit: AuditReport,
    listed: Sequence[NotableEvent],
    true_error_mm: Mapping[str, float] | None,
    *,
    with_scene: bool,
    with_pictures: bool,
) -> list[Section | None]:
    """Return the sections in the order of the report; None stands for a section that this run does not have."""
    omitted = Paragraph("They were left out, because this report belongs to a bundle without files.")
    summary = run.summary()
    return [
        deviations_section(run, listed),
        accuracy_section(summary, true_error_mm),
        later_section(summary),
        budget_section(summary),
        further_cameras_section(run),
        steps_section(run),
        people_section(run),
        notes_section(run, with_pictures=with_pictures),
        *certificate_sections(run),
        devices_section(run),
        pictures_section(run, turning=with_scene) if with_pictures else Section("Pictures", (omitted,)),
        verification_section(run, audit),
        software_section(run),
    ]


def _verification(audit: AuditReport) -> TableCell:
    if audit.ok and not audit.verified:
        return TableCell(
            "The evidence is not verified as a whole: nothing differs, but its anchors could not be read", "attention"
        )
    if audit.first_fault is None:
        return TableCell("The evidence verifies: every file and every record is as it was recorded", "ok")
    others = len(audit.faults) - 1
    more = f", and {others} more {'fault' if others == 1 else 'faults'}" if others else ""
    return TableCell(
        f"THE EVIDENCE DOES NOT VERIFY: {audit.first_fault}{more}. Nothing in this report can be relied on.", "stop"
    )


def _origin(run: RecordedRun) -> TableCell | None:
    """Return the statement on imported photographs; None if the run took its photographs itself."""
    if run.root.origin != "imported":
        return None
    return TableCell(imported_sentence(run.events[0].at_utc, run.named(run.root.operator)), "attention")


def _release(run: RecordedRun) -> TableCell | None:
    """Return the statement on the release; None if the protocol does not ask for one."""
    if run.protocol.release != "second_person":
        return None
    if run.state.released_by:
        return TableCell(f"Released by a second person: {run.named(run.state.released_by)}", "ok")
    return TableCell("NOT RELEASED: the protocol asks that a second person reads and releases this run", "stop")
