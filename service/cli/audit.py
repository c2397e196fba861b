"""`orthocapture audit`: show, verify, correct, release, report and export evidence, and manage signing keys."""

from __future__ import annotations

import base64
import getpass
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from service.audit.verifications import keep_verification, verification_of
from service.cli.common import (
    DEFAULT_DATA,
    RUN_HELP,
    DataOption,
    JsonOption,
    RunArgument,
    RunOption,
    console,
    error_console,
    print_json,
    print_table,
    progress_bar,
    reporting_errors,
    require_writable,
    require_writable_folder,
)
from service.cli.ending import ExitStatus
from service.cli.options import OperatorOption, PasswordOption, acting_name, acting_person
from service.cli.terminal_output import listed, styled
from service.core.errors import ConfigurationError, IntegrityError
from service.core.gates import release_meaning
from service.core.records.entered import cleaned_name
from service.core.units import megabytes
from service.core.words import counted
from service.followed_run import read_log
from service.people.sessions import Identity
from service.run_acts import release_run, require_releasable
from service.run_start import recorded_run
from service.store.data_folder import data_folder, kept_to
from service.store.database.engine import database_path
from service.store.durable_effects import utc_text
from service.store.records import Artefact
from service.store.runs import resolve_run
from service.store.signatures.signing import PublicKey, checkpoint, public_keys, rotate_key, sign_here
from service.store.store import Store
from service.store.verification import verify as verification
from service.store.verification.verify import AuditReport, EvidenceRecord

# --- `report` and `figures`: a report of a run, or its figures, for readers outside -------------------------------


def report_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    pdf: Annotated[
        Path | None, typer.Option("--pdf", metavar="FILE", help="Write it as PDF.", dir_okay=False)
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            "--html", metavar="FILE", help="Write it as one HTML file, with the scene in 3D.", dir_okay=False
        ),
    ] = None,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Write a report of a run: deviations, accuracy, gates, signatures, certificates, pictures, verification.

    The evidence is verified first. If it does not verify, the exit status is 1 and the report says so at the top.
    The report is recorded in the run, unless the evidence does not verify or the folder is read-only.
    A run that is not yet released can be reported as well; the report says so.
    """
    with reporting_errors(json):
        if pdf is None and html is None:
            raise ConfigurationError("no file to write", remedy="Give --pdf FILE, --html FILE, or both")
        for path in (pdf, html):
            if path is not None:
                require_writable(path)
        run_id = resolve_run(verification.list_runs(data), run)
        actor = acting_name(data, operator, "report", password_stdin=password_stdin) if _writable(data) else ""
        with progress_bar(quiet=json) as progress:
            verified = verification.verify(data, run_id, progress).with_limits()
            # Numerics, pictures and fonts take a second to load, and `audit verify` does not need them.
            from service.audit.recorded_run import read_run  # noqa: PLC0415
            from service.audit.report import report_content  # noqa: PLC0415
            from service.audit.report_output import write_html, write_pdf  # noqa: PLC0415

            progress("writing the report", 0, 1)
            report = report_content(read_run(data, run_id), verified, with_scene=html is not None)
            recorded = verified.ok and bool(actor)
            for path, write in ((pdf, write_pdf), (html, write_html)):
                if path is not None:
                    leave = partial(_record, data, run_id, report.head_sha256, actor)
                    _write(path, partial(write, report), leave if recorded else None)
    written = [str(path) for path in (pdf, html) if path is not None]
    if json:
        print_json(
            {
                "run": run_id,
                "verified": verified.ok,
                "written": written,
                "recorded": recorded,
                "head": report.head_sha256,
            }
        )
    else:
        console.print(f"Report of run {run_id}: {', '.join(written)}")
        if not recorded:
            why = "its evidence does not verify" if not verified.ok else "the data folder is read-only"
            console.print(f"  The report is not recorded in the run, because {why}.")
    if not verified.ok:
        if not json:
            error_console.tell(("The evidence does NOT verify:", "bold red"), f" {verified.first_fault}")
        raise typer.Exit(ExitStatus.FAILED)


def _write(path: Path, write: Callable[[Path], None], leave: Callable[[Path, str], None] | None) -> None:
    """Write a file under a temporary name and rename it once recorded; if recording fails, no report appears."""
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".report-") as folder:
            part = Path(folder) / path.name
            write(part)
            if leave is not None:
                leave(part, path.name)
            part.replace(path)
    except OSError as error:
        raise ConfigurationError(
            f"the report cannot be written: {error.strerror}", where=str(error.filename or path)
        ) from error


def _record(data: Path, run_id: str, head_sha256: str, actor: str, part: Path, file_name: str) -> None:
    from service.audit.bundle import record_export  # noqa: PLC0415  # loads the numerics

    with Store.open(data, create=False) as store:
        record_export(store, run_id, part, file_name=file_name, what="report", head_sha256=head_sha256, actor=actor)


def _writable(data: Path) -> bool:
    """Return whether anything can be recorded; an auditor's copy may be on a read-only medium."""
    path = database_path(data)
    return os.access(data, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))


def figures_command(
    run: RunArgument = "latest",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files.", file_okay=False)] = Path(
        "figures"
    ),
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Write every figure of a run's report as SVG and its data as CSV, with the tables of errors.

    File names begin with the number of the report's section. The evidence is verified first; if it does not verify,
    nothing is written and the exit status is 1.
    """
    with reporting_errors(json):
        require_writable_folder(out)
        run_id = resolve_run(verification.list_runs(data), run)
        with progress_bar(quiet=json) as progress:
            verified = verification.verify(data, run_id, progress).with_limits()
            if not verified.ok:
                error_console.tell(("The evidence does NOT verify:", "bold red"), f" {verified.first_fault}")
                raise typer.Exit(ExitStatus.FAILED)
            # The numerics take a second to load, and `audit verify` does not need them.
            from service.audit.recorded_run import read_run  # noqa: PLC0415
            from service.audit.report import report_content  # noqa: PLC0415
            from service.audit.report_output import figure_files, write_figures  # noqa: PLC0415

            progress("drawing the figures", 0, 1)
            recorded = read_run(data, run_id)
            files = figure_files(report_content(recorded, verified, with_scene=False), recorded.summary())
            try:
                write_figures(files, out)
            except OSError as error:
                raise ConfigurationError(
                    f"the figures cannot be written: {error.strerror}", where=str(error.filename or out)
                ) from error
    if json:
        listed = [{"name": file.name, "shows": file.shows} for file in files]
        print_json({"run": run_id, "folder": str(out), "files": listed})
        return
    if not files:
        console.print(f"Run {run_id} has no figure yet: nothing was calibrated, registered or evaluated.")
        return
    console.print(f"{counted(len(files), 'file')} of run {run_id} in {out!s}:")
    for file in files:
        console.print(f"  {file.name}: {file.shows}")


# --- evidence, verification, release and correction ---------------------------------------------------------------


def release_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    yes: Annotated[
        bool, typer.Option("--yes", help="You have read the run: sign the words that this command shows otherwise.")
    ] = False,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Release a completed run as its second person, so that it may be exported; the evidence is verified first.

    Without --yes, nothing is recorded, and the words that would be signed are shown.
    """
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, _ = recorded_run(store, run_id)
        log = read_log(store, run_id, protocol)
        meaning, signed = release_meaning(log.state), log.state.completed_sha256
        who = Identity("", "", "claimed")
        if yes:
            who = acting_person(store, operator, "release", password_stdin=password_stdin)
            require_releasable(log.state, who.name, meaning, signed)
            _require_verified(store, run_id, quiet=json)
            identified = "claimed" if who.identified == "claimed" else "password"
            release_run(log, meaning, signed, actor=who.name, identified=identified)
    if json:
        print_json({"run": run_id, "released": yes, "meaning": meaning, "signed_sha256": signed})
    elif yes:
        console.print(f"Run {run_id} is released by {who.name}: {meaning}")
    else:
        console.print(f"Not released yet. With --yes you sign, for run {run_id}: {meaning}")


def correct_command(
    event: Annotated[int, typer.Argument(help="Number of the event that holds the value.", min=1)],
    field: Annotated[str, typer.Argument(help="The field, such as environment.light_lux.")],
    value: Annotated[str, typer.Argument(help="The right value.")],
    reason: Annotated[str, typer.Option("--reason", help="Why; it goes into the record.")],
    run: RunOption = "latest",
    data: DataOption = DEFAULT_DATA,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Correct a recorded value. The original stays, and readers see both, with who, when and why."""
    from service.audit.findings import correct  # noqa: PLC0415 - `verify` does not need the overview

    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        who = acting_person(store, operator, "correct", password_stdin=password_stdin)
        made = correct(store, run_id, of_seq=event, field=field, new=value, reason=reason, actor=who.name)
    if json:
        print_json({"run": run_id, "event": made.seq, "of_event": event, "field": field})
    else:
        console.print(f"Recorded as event {made.seq}: {field} of event {event} is {value}")


def _require_verified(store: Store, run_id: str, *, quiet: bool) -> None:
    with progress_bar(quiet=quiet) as progress:
        found = verification.verify(store.database_path.parent, run_id, progress)
    if found.first_fault is not None:
        raise IntegrityError(
            f"the evidence does not verify: {found.first_fault}", where=run_id, remedy="Nothing is released"
        )
    if found.not_compared:
        raise IntegrityError(
            f"the evidence is not verified: {found.not_compared[0]}",
            where=run_id,
            remedy="Release it when the object store answers",
        )


audit_app = typer.Typer(
    name="audit",
    help="Show, verify, sign, report and export the recorded evidence of a run.",
    no_args_is_help=True,
)


def _existing_file(text: str) -> Any:
    return typer.Option(metavar="FILE", help=text, exists=True, dir_okay=False)


CertificatesOption = Annotated[
    Path | None,
    _existing_file("Certificates of the time-stamp authority (PEM), to check its signatures too."),
]
SignaturesOption = Annotated[
    Path | None,
    _existing_file("Copy of signatures.jsonl kept elsewhere, which shows whether anything was cut off since."),
]


@audit_app.command("show")
def show_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """List everything that was recorded: what happened, when, who did it, and the files."""
    with reporting_errors(json):
        run_id = resolve_run(verification.list_runs(data), run)
        records = verification.show(data, run_id)
        if json:
            print_json({"run": run_id, "events": [_record_json(record) for record in records]})
        else:
            _print_records(run_id, records)


@audit_app.command("verify")
def verify_command(
    run: Annotated[str, typer.Argument(help=RUN_HELP + " `all` checks every run of the folder.")] = "latest",
    data: DataOption = DEFAULT_DATA,
    certificates: CertificatesOption = None,
    signatures: SignaturesOption = None,
    stated_hashes: Annotated[
        bool,
        typer.Option(
            "--stated-hashes",
            help="Believe the object store's own SHA-256 of files that only it has, instead of fetching them.",
        ),
    ] = False,
    anchors: Annotated[
        Path | None,
        typer.Option(
            "--anchors",
            metavar="PATH",
            exists=True,
            help="A site.yaml in another place, or its folder, that names the object store of the anchors.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Verify the evidence: hash every file again, follow the chain, check the signatures, and name the first fault.

    The exit status is 0 if everything is as it was recorded, and 1 if anything differs or could not be compared, as
    while the object store is away.
    """
    with reporting_errors(json):
        run_id = None if run == "all" else resolve_run(verification.list_runs(data), run)
        with progress_bar(quiet=json) as report_progress:
            begun_s = time.monotonic()
            report = verification.verify(
                data,
                run_id,
                report_progress,
                certificates=certificates,
                signatures_copy=signatures,
                stated_hashes=stated_hashes,
                anchors_of=None if anchors is None else data_folder(anchors),
            ).with_limits()
        _tell_the_pages(data, report, time.monotonic() - begun_s)
    if json:
        print_json(report_json(report))
    else:
        _print_report(report)
    if not report.verified:
        raise typer.Exit(ExitStatus.FAILED)


def _tell_the_pages(data: Path, report: AuditReport, took_s: float) -> None:
    """Save the result for the audit's pages, if the folder is writable."""
    by, at_utc = f"{cleaned_name(getpass.getuser())} (command line)", utc_text(datetime.now(UTC))
    for run_id in report.runs:
        with suppress(OSError), kept_to(data):
            found = verification_of(report, run_id, by=by, at_utc=at_utc, duration_s=took_s)
            keep_verification(data, run_id, found)


@audit_app.command("checkpoint")
def checkpoint_command(
    run: RunArgument = "latest", data: DataOption = DEFAULT_DATA, json: JsonOption = False
) -> None:
    """Sign the end of a run's chain now, so that nothing up to it can be rewritten unnoticed."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        made = checkpoint(store, store.find_run(run))
    if json:
        print_json(asdict(made))
    else:
        console.print(f"Run {made.run_id} is signed up to event {made.seq} with key {made.key_id}.")


@audit_app.command("keys")
def keys_command(data: DataOption = DEFAULT_DATA, json: JsonOption = False) -> None:
    """Show the fingerprints of the signing keys. Write them down elsewhere: bundles are checked against them."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        keys = public_keys(store)
    if json:
        print_json({"keys": [_key_json(key) for key in keys]})
        return
    if not keys:
        console.print("No key has signed anything in this folder yet.")
    for key in keys:
        state = "in use" if key.replaced_seq is None else "replaced"
        gap = "" if key.introduced or key is keys[0] else ", not vouched for by the key before it"
        console.tell(f"{key.key_id}  {state}", (gap, "yellow"), f"  ({key.reason})")


@audit_app.command("sign-here")
def sign_here_command(
    data: DataOption = DEFAULT_DATA,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Let this data folder sign a site whose database several folders share, instead of the one that signs now.

    First end the processes of that folder and move its keys/ and signatures.jsonl here.
    """
    with reporting_errors(json), Store.open(data, create=False) as store:
        who = acting_person(store, operator, "administer", password_stdin=password_stdin)
        made = sign_here(store, actor=who.name)
    if json:
        print_json(asdict(made))
    else:
        console.print(f"This folder signs the site from now on, with key {made.key_id}.")


@audit_app.command("rotate-key")
def rotate_key_command(
    reason: Annotated[str, typer.Option(help="Why the key is replaced; it is recorded.")],
    data: DataOption = DEFAULT_DATA,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    lost: Annotated[
        bool, typer.Option("--lost", help="The old key's file is gone and cannot vouch for the new one.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Replace the signing key. The old key signs the new one, and then its file is destroyed."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        who = acting_person(store, operator, "administer", password_stdin=password_stdin)
        key = rotate_key(store, reason=reason, actor=who.name, lost=lost)
    if json:
        print_json(_key_json(key))
    else:
        console.print(f"The key is now {key.key_id}. Write this fingerprint down elsewhere.")


@audit_app.command("export")
def export_command(
    run: RunArgument,
    bundle: Annotated[
        Path, typer.Argument(help="The zip file to write; for a simulated run SIMULATED is added to its name.")
    ],
    data: DataOption = DEFAULT_DATA,
    hashes_only: Annotated[
        bool, typer.Option("--hashes-only", help="Leave out the recorded files; the records hold their hashes.")
    ] = False,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Write a run's evidence to one zip file that anybody can verify, with a report and the verifier inside.

    It is refused if the evidence does not verify, or if a release that the protocol requires is missing.
    """
    # Imported here because they load the numerics, which `verify` does not need.
    from service.audit.bundle import bundle_report, export_bundle  # noqa: PLC0415

    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        require_writable(bundle)
        who = acting_person(store, operator, "report", password_stdin=password_stdin)
        with progress_bar(quiet=json) as report_progress:
            made = export_bundle(
                store,
                run_id,
                bundle,
                actor=who.name,
                hashes_only=hashes_only,
                report=bundle_report(data, run_id, with_pictures=not hashes_only),
                progress=report_progress,
            )
    if json:
        print_json({**asdict(made), "path": str(made.path)})
        return
    console.print(f"{made.path!s}: {megabytes(made.size_bytes):.1f} MB, SHA-256 {made.sha256}")
    console.print(f"  signed with key {made.key_id}")
    console.print(f"  To verify it anywhere: python -I verify.py {made.path.name} --key {made.key_id}")


def _key_json(key: PublicKey) -> dict[str, Any]:
    return {
        "key_id": key.key_id,
        "public_key": base64.b64encode(key.public_key).decode(),
        "in_use": key.replaced_seq is None,
        "introduced_by_predecessor": key.introduced,
        "reason": key.reason,
    }


def report_json(report: AuditReport) -> dict[str, Any]:
    """Return a verification report as plain data, with `ok` and `first_fault` added."""
    first = None if report.first_fault is None else {**asdict(report.first_fault), "text": str(report.first_fault)}
    fields = asdict(report)
    del fields["not_judged"]  # among the notes
    if report.anchors is None:
        del fields["anchors"]
    if report.anchors is None and not report.not_compared:
        del fields["not_compared"]
    return {"ok": report.ok, "first_fault": first, **fields}


def _record_json(record: EvidenceRecord) -> dict[str, Any]:
    return {**asdict(record), "artefacts": [_artefact_json(artefact) for artefact in record.artefacts]}


def _artefact_json(artefact: Artefact) -> dict[str, Any]:
    return {
        **artefact.ref.model_dump(),
        "device": artefact.device,
        "step": artefact.step,
        "attempt": artefact.attempt,
        "viewpoint": artefact.viewpoint,
        "who": artefact.who,
        "at_utc": artefact.at_utc,
        "monotonic_s": artefact.monotonic_s,
    }


def _print_records(run_id: str, records: Sequence[EvidenceRecord]) -> None:
    table = Table(title=f"Run {run_id}: {counted(len(records), 'event')}", title_justify="left")
    for heading in ("no.", "time (UTC)", "who", "what", "details"):
        table.add_column(heading, overflow="fold")
    for record in records:
        lines = [styled(record.summary)]
        lines += [
            styled(
                ("file", "dim"),
                f" {artefact.ref.original_name} ({artefact.ref.kind}, {artefact.ref.size_bytes} bytes, "
                f"from {artefact.device}, SHA-256 {artefact.ref.sha256[:12]}…)",
            )
            for artefact in record.artefacts
        ]
        table.add_row(
            str(record.seq),
            record.at_utc[:23].replace("T", " "),
            record.actor,
            record.kind.replace("_", " "),
            listed(*lines),
        )
    print_table(table)


def _print_report(report: AuditReport) -> None:
    console.print(
        f"Checked {counted(len(report.runs), 'run')} in {report.data_dir}: "
        f"{counted(report.events, 'event')}, {counted(report.artefacts, 'recorded file')} "
        f"({megabytes(report.bytes_hashed):.1f} MB read again), {counted(report.jobs, 'job')}, "
        f"{counted(report.checkpoints, 'signature')}."
    )
    if report.anchors is not None and not report.not_compared:
        console.print(
            f"Compared with the object store: {counted(report.anchors.lines, 'anchored signature')}, "
            f"{counted(report.anchors.roots, 'daily root')} with {counted(report.anchors.heads, 'end')} of chains."
        )
    for run_id, head in report.heads.items():
        console.print(f"  {run_id} ends with {head}")
    for key_id in report.key_ids:
        console.print(f"  signed with key {key_id}")
    for note in report.notes:
        console.tell(("  note:", "yellow"), f" {note}")
    if report.ok and report.not_compared:
        console.tell(("NOT verified as a whole.", "bold yellow"), " Nothing differs, but not all could be compared.")
        return
    if report.first_fault is None:
        console.tell(("Verified:", "bold green"), " everything is as it was recorded.")
        return
    console.tell(("NOT verified.", "bold red"), f" First fault: {report.first_fault}")
    if len(report.faults) > 1:
        console.print(f"  and {len(report.faults) - 1} more; all of them with --json")
    console.print("  Keep this folder as it is, and compare it with a copy made earlier.")


audit_app.command("release")(release_command)
audit_app.command("correct")(correct_command)
audit_app.command("report")(report_command)
audit_app.command("figures")(figures_command)
