"""Entries and notes in a report: what was entered at the start of a run, and the notes on its steps."""

from __future__ import annotations

from textwrap import wrap

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Block, Column, Heading, Pictures, Section, Table, TableCell
from service.audit.report.drawings.pictures import picture
from service.audit.report.words import utc
from service.core.records.entered import NoteTaken, about_rows

_WIDTH_PX = 500
_PIECE_CHARACTERS = 900


def about_facts(run: RecordedRun) -> list[tuple[str, TableCell | str]]:
    """What was entered when the run began; empty for old runs, which did not ask."""
    rows: list[tuple[str, TableCell | str]] = []
    for name, value in about_rows(run.root.about):
        rows += [(name if part == 0 else "", text) for part, text in enumerate(_pieces(value))]
    return rows


def _pieces(text: str) -> list[str]:
    """A long text in parts, because a row of a table has to fit on a page."""
    return wrap(text, _PIECE_CHARACTERS, replace_whitespace=False, break_on_hyphens=False) or [""]


def notes_section(run: RecordedRun, *, with_pictures: bool) -> Section | None:
    """Every note with its step, time and author, and the photographs; None without any."""
    titles = {step.id: step.title for step in run.protocol.steps}
    notes = [(event, event.payload) for event in run.events if isinstance(event.payload, NoteTaken)]
    if not notes:
        return None
    rows: list[tuple[str, ...]] = []
    for event, note in notes:
        head = (str(event.seq), utc(event.at_utc), titles.get(note.step, note.step), run.named(event.actor))
        text = " ".join([note.text, "[photograph]"] if note.photograph is not None else [note.text]).strip()
        rows += [(*(head if part == 0 else ("",) * 4), piece) for part, piece in enumerate(_pieces(text))]
    columns = (
        Column("event", 0.5, "number"),
        Column("time", 1.35),
        Column("step", 1.3),
        Column("who", 1.0),
        Column("note", 3.6),
    )
    blocks: list[Block] = [Table(columns, tuple(rows))]
    pictures = tuple(
        picture(
            run, note.photograph.sha256, f"event {event.seq}: {note.text[:120]}".rstrip(": "), _WIDTH_PX, upright=True
        )
        for event, note in notes
        if note.photograph is not None
    )
    if pictures and with_pictures:
        blocks += [Heading("Photographs of the notes"), Pictures(pictures, 3)]
    return Section("Notes", tuple(blocks))
