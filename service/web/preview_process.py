"""Makes a preview in a separate process, so that pages stay fast: `python -m service.web.preview_process`.

It ends when the process that started it ends.
"""

from __future__ import annotations

import sys
from pathlib import Path

from service.audit.background import Progress, report
from service.machine.resources import compute_in_background


def preview(data: Path, run_id: str, folder: Path, progress: Progress) -> str:
    """Make the preview of a run in a folder. Returns the folder's name. Raises OrthocaptureError."""
    from service.audit.recorded_run import read_run  # noqa: PLC0415 - these load the numerics
    from service.dataset.preview import make_preview  # noqa: PLC0415

    progress("reading the run", 0, 0)
    make_preview(read_run(data, run_id).summary(), folder, progress)
    return folder.name


if __name__ == "__main__":
    compute_in_background()  # a capture and its worker need the processor more
    report(
        lambda progress: preview(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), progress), outlives_parent=False
    )
