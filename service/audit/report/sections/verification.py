"""The report's section on verification: what was verified, the signing keys, and how anyone can verify it again."""

from __future__ import annotations

from collections.abc import Iterator

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Block, Column, DescriptionList, Heading, Paragraph, Section, Table, TableCell
from service.core.text.words import counted
from service.core.units import megabytes
from service.store.verification.verify import AuditReport

_FAULTS_SHOWN = 20
_HOW = (
    "Every event holds the SHA-256 of the one before it, so the chain head stands for all of them, and every file is "
    "named in an event by its SHA-256. With the data folder: orthocapture audit verify {run} reads every file again, "
    "and orthocapture replay {run} computes calibration, registration and evaluation again and compares. Without "
    "orthocapture: the bundle made by orthocapture audit export holds verify.py, one file that needs only Python and "
    "the package cryptography; start it with python -I. Compare the chain head and the key's fingerprint above with "
    "those written down elsewhere."
)
_PART_11 = (
    "Part 11-style controls: append-only records with person, time and reason; signatures that ask for the password "
    "again and are bound to the hash of what was signed; corrections that keep the original. No authority has "
    "assessed this software, and it claims no conformity with any regulation."
)


def verification_section(run: RecordedRun, audit: AuditReport) -> Section:
    """Verification, chain head, keys, and how to do it again."""
    blocks: list[Block] = [_checked(run, audit)]
    if audit.faults:
        blocks += _faults(audit)
    blocks += [Paragraph(note[:1].upper() + note[1:] + ".", "attention") for note in audit.notes[:_FAULTS_SHOWN]]
    blocks += [Heading("How to verify"), Paragraph(_HOW.format(run=run.run_id)), Paragraph(_PART_11)]
    return Section("Verification", tuple(blocks))


def _checked(run: RecordedRun, audit: AuditReport) -> DescriptionList:
    """How much was checked, the chain head, and the keys."""
    head = run.events[-1]
    unsigned = audit.unsigned_events.get(run.run_id, 0)
    rows: list[tuple[str, TableCell | str]] = [
        (
            "Evidence",
            TableCell("verified", "ok") if audit.ok else TableCell(counted(len(audit.faults), "fault"), "stop"),
        ),
        (
            "Records walked",
            f"{counted(audit.events, 'event')}, {counted(audit.artefacts, 'artefact row')}, "
            f"{counted(audit.jobs, 'job')}",
        ),
        ("Files hashed again", f"{audit.files}, {megabytes(audit.bytes_hashed):.1f} MB"),
        (f"Chain head (event {head.seq})", head.sha256),
        (
            "Signed checkpoints (Ed25519)",
            str(audit.checkpoints) if audit.checkpoints else TableCell("none", "attention"),
        ),
        ("Events after the last checkpoint", str(unsigned)),
        ("Time stamps of an authority (RFC 3161)", str(audit.timestamps) if audit.timestamps else "none"),
    ]
    names = ("Public key, fingerprint (SHA-256)", "Later public key, fingerprint")
    rows += [(names[min(n, 1)], key_id) for n, key_id in enumerate(audit.key_ids)]
    return DescriptionList(tuple(rows))


def _faults(audit: AuditReport) -> Iterator[Block]:
    shown = audit.faults[:_FAULTS_SHOWN]
    columns = (Column("event", 0.5, "number"), Column("file", 2.0, "code"), Column("what does not verify", 3.0))
    texts = tuple(("" if f.seq is None else str(f.seq), f.file, TableCell(f.what, "stop")) for f in shown)
    yield Heading("Faults")
    yield Table(columns, texts)
    if len(audit.faults) > len(shown):
        yield Paragraph(f"and {len(audit.faults) - len(shown)} more: see orthocapture audit verify.")
