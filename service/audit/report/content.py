"""The content of a report, made from a run's evidence; report/output writes it as HTML or PDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Paragraph, Report, Section, TableCell
from service.audit.report.sections.accuracy import accuracy_section, budget_section, later_section, result_sentence
from service.audit.report.sections.certificates import certificate_sections
from service.audit.report.sections.course import (
    NotableEvent,
    deviations,
    deviations_section,
    no_deviation,
    people_section,
    steps_section,
)
from service.audit.report.sections.facts import facts
from service.audit.report.sections.further_cameras import further_cameras_section
from service.audit.report.sections.notes import notes_section
from service.audit.report.sections.origin import devices_section, software_section
from service.audit.report.sections.photographs import pictures_section
from service.audit.report.sections.verification import verification_section
from service.core.records.import_list import imported_sentence
from service.core.text.words import counted
from service.store.verification.verify import AuditReport


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
        audit: the result of the verification, which is shown on the first page.
        made_at: the time stamp of the report, default: now. The same evidence and time stamp give the same report.
        true_error_mm: by source of poses, on a simulated rig, where the truth is known; marked as such.
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
    """In the order of the report; None for a section that this run does not have."""
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
    if audit.first_fault is None:
        return TableCell("The evidence verifies: every file and every record is as it was recorded", "ok")
    others = len(audit.faults) - 1
    more = f", and {others} more {'fault' if others == 1 else 'faults'}" if others else ""
    return TableCell(
        f"THE EVIDENCE DOES NOT VERIFY: {audit.first_fault}{more}. Nothing in this report can be relied on.", "stop"
    )


def _origin(run: RecordedRun) -> TableCell | None:
    """The statement on imported photographs; None if the run took its photographs itself."""
    if run.root.origin != "imported":
        return None
    return TableCell(imported_sentence(run.events[0].at_utc, run.named(run.root.operator)), "attention")


def _release(run: RecordedRun) -> TableCell | None:
    """The statement on the release; None if the protocol does not ask for one."""
    if run.protocol.release != "second_person":
        return None
    if run.state.released_by:
        return TableCell(f"Released by a second person: {run.named(run.state.released_by)}", "ok")
    return TableCell("NOT RELEASED: the protocol asks that a second person reads and releases this run", "stop")
