"""The origin of the data, which is devices, clocks and software, and how it was and can be verified."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from service.audit.recorded_run import RecordedRun
from service.audit.report_blocks import (
    Block,
    Column,
    DescriptionList,
    Heading,
    Paragraph,
    Section,
    Table,
    TableCell,
    clock,
)
from service.computations import term
from service.core.recorded_devices import CameraBodies, bodies, clock_offset_words, clock_readings, recorded_report
from service.core.records.run_events import DeviceOpened, JobFinished, SessionStarted, ViewpointCaptured
from service.core.units import megabytes, ms, um
from service.core.words import counted
from service.steps.notes import deidentified
from service.store.verification.verify import AuditReport

_COMPUTES = ("orthocapture", "numpy", "scipy", "opencv-python-headless", "pycolmap", "trimesh", "scikit-image")


def devices_section(run: RecordedRun) -> Section:
    """Return every device that answered, its versions and clocks; light and temperature over the captures."""
    known = bodies(run.events)
    blocks: list[Block] = [_devices(run, known)]
    blocks += [Paragraph(f"{text}.") for text in known.explained]
    if known.strange:
        blocks.append(Paragraph(f"{known.strange}.", "stop"))
    blocks += [Paragraph(f"{one.words}.") for state in run.state.steps.values() for one in deidentified(state)]
    blocks += _clocks(run)
    captures = [view for view in run.summary().captures() if isinstance(view, ViewpointCaptured)]
    if captures:
        blocks.append(Paragraph(_stillness(captures) + _environment(captures)))
    return Section("Devices and clocks", tuple(blocks))


def _devices(run: RecordedRun, known: CameraBodies) -> Table:
    columns = (
        Column("device", 0.8),
        Column("model", 1.6),
        Column("serial number", 1.2),
        Column("firmware", 1.1),
        Column("driver", 1.9),
        Column("its clock when it was opened", 1.7),
        Column("opened (UTC)", 0.9),
    )
    rows: list[tuple[TableCell | str, ...]] = []
    for event in run.events:
        if isinstance(event.payload, DeviceOpened):
            report = recorded_report(event.payload.report)
            identity = report.identity
            rows.append(
                (
                    event.payload.device,
                    identity.model,
                    known.shown(identity) or "–",
                    identity.firmware or "–",
                    f"{identity.driver}: {identity.driver_version}",
                    clock_offset_words(report.clock_offset_s, report.clock),
                    clock(event.at_utc),
                )
            )
    return Table(columns, tuple(rows), small=True)


def _stillness(captures: list[ViewpointCaptured]) -> str:
    """Return the drift of the robot's clock over the captures, and the motion of the flange during exposures."""
    offsets = np.array([capture.clock_offset_s for capture in captures])
    sigma_m = max(capture.pose_sigma_m for capture in captures)
    return (
        f"Over {counted(len(captures), 'capture')} the offset of the robot's clock from the host's monotonic clock "
        f"stayed within {ms(float(np.ptp(offsets))):.1f} ms; the flange stood still within {um(sigma_m):.2f} µm (1σ) "
        "during every exposure."
    )


def _clocks(run: RecordedRun) -> Iterator[Block]:
    """Yield the last comparison of each clock, and what depends on it."""
    readings = clock_readings(run.events)
    if not readings:
        return
    columns = (
        Column("clock of", 0.9),
        Column("against", 1.1),
        Column("difference", 1.0, "number"),
        Column("limit", 0.8, "number"),
        Column("verdict", 0.9),
        Column("what it means", 3.6),
    )
    verdicts = {
        True: TableCell("✓ within", "ok"),
        False: TableCell("✗ beyond", "stop"),
        None: TableCell("? not known", "attention"),
    }
    yield Heading("Clocks")
    yield Table(
        columns,
        tuple(
            (
                reading.name,
                reading.other,
                reading.difference,
                f"± {reading.limit_s:.2f} s",
                verdicts[reading.within],
                f"{reading.meaning}{f' ({reading.note})' if reading.note else ''}.",
            )
            for reading in readings
        ),
    )


def _environment(captures: list[ViewpointCaptured]) -> str:
    parts: list[str] = []
    for key, name, unit, digits in (("light_lux", "light", "lx", 0), ("temperature_c", "temperature", "°C", 1)):
        values = [capture.environment[key] for capture in captures if key in capture.environment]
        if values:
            parts.append(f"{name} {min(values):.{digits}f} to {max(values):.{digits}f} {unit}")
    return f" Meanwhile: {', '.join(parts)}." if parts else ""


def software_section(run: RecordedRun) -> Section:
    """Return the software, the number and duration of the computations, and every installed distribution."""
    sessions = [event.payload for event in run.events if isinstance(event.payload, SessionStarted)]
    software = sessions[-1].software if sessions else run.root.software
    first = ", ".join(f"{name} {software[name]}" for name in _COMPUTES if name in software)
    differing = [s for s in sessions if s.software != run.root.software]
    blocks: list[Block] = [Paragraph(f"Computed with {first}.")]
    if differing:
        blocks.append(
            Paragraph(
                f"{len(differing)} of {counted(len(sessions), 'session')} ran with other versions.", "attention"
            )
        )
    jobs: dict[str, tuple[int, float]] = {}
    for event in run.events:
        if isinstance(event.payload, JobFinished):
            count, seconds = jobs.get(event.payload.job_kind, (0, 0.0))
            jobs[event.payload.job_kind] = count + 1, seconds + event.payload.duration_s
    if jobs:
        columns = (Column("computed", 2.0), Column("times", 1.0, "number"), Column("seconds together", 1.0, "number"))
        rows = tuple((term(kind), str(n), f"{seconds:.1f}") for kind, (n, seconds) in jobs.items())
        blocks.append(Table(columns, rows))
    names = sorted(software, key=str.lower)
    texts = [f"{name} {software[name]}" for name in names]
    texts += [""] * (-len(texts) % 3)
    third = len(texts) // 3
    rows = tuple(zip(texts[:third], texts[third : 2 * third], texts[2 * third :], strict=True))
    blocks += [
        Heading("Every installed distribution"),
        Table((Column(""), Column(""), Column("")), rows, small=True),
    ]
    return Section("Software", tuple(blocks))


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
    """Return verification, chain head, keys, and how to do it again."""
    blocks: list[Block] = [_checked(run, audit)]
    if audit.faults:
        blocks += _faults(audit)
    blocks += [Paragraph(note[:1].upper() + note[1:] + ".", "attention") for note in audit.notes[:_FAULTS_SHOWN]]
    blocks += [Heading("How to verify"), Paragraph(_HOW.format(run=run.run_id)), Paragraph(_PART_11)]
    return Section("Verification", tuple(blocks))


def _checked(run: RecordedRun, audit: AuditReport) -> DescriptionList:
    """Return how much was checked, the chain head, and the keys."""
    head = run.events[-1]
    unsigned = audit.unsigned_events.get(run.run_id, 0)
    rows: list[tuple[str, TableCell | str]] = [
        (
            "Evidence",
            _verdict(audit),
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


def _verdict(audit: AuditReport) -> TableCell:
    if not audit.ok:
        return TableCell(counted(len(audit.faults), "fault"), "stop")
    return TableCell("verified", "ok") if audit.verified else TableCell("not verified as a whole", "attention")


def _faults(audit: AuditReport) -> Iterator[Block]:
    shown = audit.faults[:_FAULTS_SHOWN]
    columns = (Column("event", 0.5, "number"), Column("file", 2.0, "code"), Column("what does not verify", 3.0))
    texts = tuple(("" if f.seq is None else str(f.seq), f.file, TableCell(f.what, "stop")) for f in shown)
    yield Heading("Faults")
    yield Table(columns, texts)
    if len(audit.faults) > len(shown):
        yield Paragraph(f"and {len(audit.faults) - len(shown)} more: see orthocapture audit verify.")
