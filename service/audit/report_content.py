"""What a report says, put together from a run's evidence; how it looks is report_html's and report_pdf's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime

from service.audit.not_in_yet import not_in_yet
from service.audit.recorded import RecordedRun
from service.audit.report_accuracy import accuracy_section, budget_section, later_section, result_sentence
from service.audit.report_blocks import Cell, Facts, Paragraph, Report, Section
from service.audit.report_certificates import certificate_sections
from service.audit.report_course import deviations, deviations_section, people_section, steps_section
from service.audit.report_notes import about_facts, notes_section
from service.audit.report_origin import devices_section, pictures_section, software_section
from service.audit.report_verification import verification_section
from service.audit.report_words import duration, utc
from service.core.imported import imported_sentence
from service.core.late import late_results
from service.store.audit import AuditReport


def report_content(
    run: RecordedRun,
    audit: AuditReport,
    *,
    made_at: datetime | None = None,
    true_error_mm: Mapping[str, float] | None = None,
    with_scene: bool = True,
    with_pictures: bool = True,
) -> Report:
    """The report of a run.

    Args:
        run: the run.
        audit: what verifying it gave, before anything else; the first page says so.
        made_at: the time stamp of the report; now unless given. With the same one the same evidence gives the same.
        true_error_mm: by source of poses, on a simulated rig where the truth is known; marked as such.
        with_scene: the 3D scene as well, which only HTML can show.
        with_pictures: False leaves out what shows the photographs.
    """
    summary = run.summary()
    listed = deviations(run)
    result = result_sentence(summary)
    sections = [
        deviations_section(run, listed),
        accuracy_section(summary, true_error_mm),
        later_section(summary),
        budget_section(summary),
        steps_section(run),
        people_section(run),
        notes_section(run, with_pictures=with_pictures),
        *certificate_sections(run),
        devices_section(run),
        pictures_section(run, with_scene=with_scene)
        if with_pictures
        else Section("Pictures", (Paragraph("They were left out: this report goes with hashes alone."),)),
        verification_section(run, audit),
        software_section(run),
    ]
    return Report(
        title=run.protocol.title,
        simulated=run.root.simulated,
        origin=_origin(run),
        verification=_verification(audit),
        result=result,
        deviations=Cell(f"{len(listed)} deviations, listed first", "attention")
        if listed
        else Cell("No deviation: every step was done as the protocol says", "ok"),
        release=_release(run),
        facts=_facts(run),
        sections=tuple(section for section in sections if section is not None),
        run_id=run.run_id,
        head_sha256=run.events[-1].sha256,
        made_utc=utc((made_at or datetime.now(UTC)).isoformat()),
    )


def _verification(audit: AuditReport) -> Cell:
    if audit.first_fault is None:
        return Cell("The evidence verifies: every file and every record is as it was recorded", "ok")
    more = f", and {len(audit.faults) - 1} more faults" if len(audit.faults) > 1 else ""
    return Cell(
        f"THE EVIDENCE DOES NOT VERIFY: {audit.first_fault}{more}. Nothing in this report can be relied on.", "stop"
    )


def _origin(run: RecordedRun) -> Cell | None:
    """None where the run captured its photographs itself."""
    if run.root.origin != "imported":
        return None
    return Cell(imported_sentence(run.events[0].at_utc, run.named(run.root.operator)), "attention")


def _release(run: RecordedRun) -> Cell | None:
    """None where the protocol asks for no release."""
    if run.protocol.release != "second_person":
        return None
    if run.state.released_by:
        return Cell(f"Released by a second person: {run.named(run.state.released_by)}", "ok")
    return Cell("NOT RELEASED: the protocol asks that a second person reads and releases this run", "stop")


def _later(run: RecordedRun) -> Iterator[tuple[str, Cell]]:
    late = late_results(run.protocol, run.state)
    if late:
        yield "Results that came after the evaluation", Cell(", ".join(one.name for one in late), "attention")
    missing = not_in_yet(run.protocol, run.state, run.events)
    if missing:
        yield "Results not in yet", Cell("; ".join(missing), "attention")


def _facts(run: RecordedRun) -> Facts:
    root, state, events = run.root, run.state, run.events
    views = sum(len(step.captured) for step in state.steps.values())
    others = sorted(run.named(person) for person in state.people - {root.operator})
    status = {"active": "not finished"}.get(state.status, state.status)
    return Facts(
        (
            ("Run", run.run_id),
            *about_facts(run),
            ("Begun", utc(events[0].at_utc)),
            ("Last record", f"{utc(events[-1].at_utc)}, after {duration(events[0].at_utc, events[-1].at_utc)}"),
            (
                "State",
                Cell(
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
            ("Photographs that count", str(views)),
            ("Records", str(len(events))),
            ("Chain head", events[-1].sha256),
        )
    )
