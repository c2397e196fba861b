"""The report in a bundle."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from service.store.verification.verify import AuditReport


def bundle_report(data: Path, run_id: str, *, with_pictures: bool) -> Callable[[AuditReport, int], bytes]:
    """Returns a function that makes the HTML report of a run up to an event from the result of its verification.

    The report is dated by the last event in the bundle, so that the same evidence gives the same bytes.
    """

    def make(audit: AuditReport, last_seq: int) -> bytes:
        # Imported here because numerics, pictures and the 3D scene take long to load, and only the report needs them.
        from service.audit.record.run import read_run  # noqa: PLC0415
        from service.audit.report.content import report_content  # noqa: PLC0415
        from service.audit.report.output.html import render_html  # noqa: PLC0415

        run = read_run(data, run_id, last_seq=last_seq)
        made_at = datetime.fromisoformat(run.events[-1].at_utc)
        report = report_content(run, audit, made_at=made_at, with_scene=with_pictures, with_pictures=with_pictures)
        return render_html(report).encode()

    return make
