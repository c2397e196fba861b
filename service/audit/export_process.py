"""Makes one export in a process of its own, so that pages stay fast: `python -m service.audit.export_process`.

It finishes the export even if the process that started it has ended.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from service.audit.background import Progress, ends_tidily_when_stopped, report
from service.audit.bundle import bundle_report, export_bundle, marked_name, record_export, require_exportable
from service.audit.bundle_contents import writing_bundle
from service.audit.exports import FORMAT, forget_request, kept_request
from service.core.errors import ConfigurationError
from service.machine.executors import computing_as_environment_says
from service.machine.resources import compute_in_background
from service.store.artefacts import chunks_of
from service.store.disk_space import require_export_space
from service.store.store import Store

if TYPE_CHECKING:
    from service.audit.recorded_run import RecordedRun
    from service.store.verification.verify import AuditReport

_OLDEST = (1980, 1, 1, 0, 0, 0)  # the earliest time in zip; the files state their own dates


def export(data: Path, run_id: str, what: str, target: Path, actor: str, progress: Progress) -> Path:
    """Make a bundle, a data set or a report, and record the export. Returns the file or, of a format, the folder.

    Raises OrthocaptureError, for example if the evidence does not verify or the run was not released.
    """
    with Store.open(data, create=False) as store:
        if what == FORMAT:
            return _in_format(store, run_id, target, actor, progress)
        if what in ("bundle", "hashes"):
            hashes_only = what == "hashes"
            html = bundle_report(data, run_id, with_pictures=not hashes_only)
            made = export_bundle(
                store, run_id, target, actor=actor, hashes_only=hashes_only, report=html, progress=progress
            )
            return made.path
        if what == "dataset":
            require_export_space(store, run_id, target)
        exportable = require_exportable(store, run_id, progress, unreleased=what in ("report", "report_pdf"))
        # Imported here because numerics and typesetting take long to load, and a bundle needs neither.
        from service.audit.recorded_run import read_run  # noqa: PLC0415

        run = read_run(data, run_id)
        path = target.with_name(marked_name(target.name, simulated=run.root.simulated))
        progress("writing", 0, 0)
        kind = "dataset" if what == "dataset" else "report"

        def leave(part: Path) -> None:
            head_sha256 = run.events[-1].sha256
            record_export(store, run_id, part, file_name=path.name, what=kind, head_sha256=head_sha256, actor=actor)

        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".export-") as folder:
            part = Path(folder) / "part"
            if what == "dataset":
                _write_dataset(run, part, path, leave)
            elif what in ("report", "report_pdf"):
                _write_report(run, exportable.audit, part, pdf=what == "report_pdf")
                leave(part)
                part.replace(path)
            else:
                raise ConfigurationError(f"nothing is called {what!r}", where="what")
        return path


def _in_format(store: Store, run_id: str, target: Path, actor: str, progress: Progress) -> Path:
    """Write the format that the request beside the folder names; goes on with what an interrupted export wrote."""
    from service.audit.data_set_export import export_data_set  # noqa: PLC0415 - as above

    try:
        export_data_set(store, run_id, kept_request(target).wanted, target, actor, progress)
    finally:
        forget_request(target)
    return target


def _write_dataset(run: RecordedRun, folder: Path, target: Path, leave: Callable[[Path], None]) -> None:
    from service.audit.recorded_run import not_in_yet  # noqa: PLC0415
    from service.dataset.exporter import exporter, write_data_set  # noqa: PLC0415
    from service.dataset.run_data_set import data_set_of  # noqa: PLC0415

    missing = not_in_yet(run.protocol, run.state, run.events)
    write_data_set(data_set_of(run.summary(), missing), exporter("plain"), folder)
    with writing_bundle(target, _OLDEST, leave) as archive:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            compress = path.suffix.lower() not in (".jpg", ".jpeg", ".png", ".npz")
            archive.add(path.relative_to(folder).as_posix(), chunks_of(path), compress=compress)


def _write_report(run: RecordedRun, audit: AuditReport, path: Path, *, pdf: bool) -> None:
    from service.audit.report import report_content  # noqa: PLC0415
    from service.audit.report_output import write_html, write_pdf  # noqa: PLC0415

    (write_pdf if pdf else write_html)(report_content(run, audit, with_scene=not pdf), path)


def main(arguments: list[str]) -> None:
    """Make the export, and write progress and the name of the file to stdout."""
    ends_tidily_when_stopped()
    data, run_id, what, target, actor = arguments

    def work(progress: Progress) -> str:
        with computing_as_environment_says():
            return export(Path(data), run_id, what, Path(target), actor, progress).name

    report(work, outlives_parent=True)


if __name__ == "__main__":
    compute_in_background()  # it may use all processors; a capture and its worker need them more
    main(sys.argv[1:])
