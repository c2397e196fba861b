"""Every duration that a gate or a timer judges, and each file that looks at UTC: what tries it, or why not."""

from __future__ import annotations

import re

from tests.support.clocks.durations import RUN_DURATIONS
from tests.support.clocks.people import PEOPLE_DURATIONS
from tests.support.rig.rig import REPOSITORY

DURATIONS = (*RUN_DURATIONS, *PEOPLE_DURATIONS)
_LOOKS = re.compile(
    r"utc_s\(|utc_now\(|fromisoformat|st_mtime|st_ctime|getmtime|[^_]elapsed\(|age_s\(|time\.time\(|julianday|"
    r"_utc_s\b|boot_time"
)
_STAMP = "a time that is recorded, named or shown; nothing is judged by it"
_FIGURE = "an estimate or a figure for people; it is never negative, and nothing waits for it"
_CHANGE = "whether a file has changed, by its time being another one"
#: Every file that looks at UTC, at a file's time or at the boot's: the row that tries what it judges, or why not.
PLACES = {
    "drivers/dicom_folder/folder.py": _CHANGE,
    "drivers/genicam/__init__.py": "released_images has nothing to leave out: each image was asked for",
    "drivers/gphoto/camera.py": "the camera's clock against the host's at one exposure, which is shown",
    "drivers/interfaces/camera.py": "a photograph of the step",
    "drivers/meshes/export_watch.py": _CHANGE,
    "drivers/meshes/mesh_file.py": _CHANGE,
    "drivers/photo_watch.py": "a photograph of the step",
    "drivers/photos/photo_file.py": "a photograph of the step",
    "drivers/photos/photo_folder.py": _CHANGE,
    "drivers/scan_folder.py": "the newest of several files, for a recording of devices",
    "drivers/video.py": "released_images has nothing to leave out: each image was asked for",
    "service/audit/background.py": _STAMP,
    "service/audit/bundle_contents.py": _STAMP,
    "service/audit/bundle.py": _STAMP,
    "service/audit/exports.py": _STAMP,
    "service/web/site.py": "by how much UTC was set between two starts of one boot, which is recorded",
    "service/audit/report_blocks.py": _FIGURE,
    "service/audit/comparison.py": _FIGURE,
    "service/audit/verifications.py": _STAMP,
    "service/benchmark/methods.py": "the newest of several files",
    "service/cli/runs.py": "days that a person asks for",
    "service/cli/doctor.py": _STAMP,
    "service/cli/serve.py": _STAMP,
    "service/compute/sfm/front_end.py": _CHANGE,
    "service/core/recorded_devices.py": "offsets of cameras' clocks within one process, which are shown",
    "service/core/records/base.py": "age of the coat",
    "service/core/run/expected.py": f"{_FIGURE}; {_STAMP}",
    "service/core/words.py": _STAMP,
    "service/core/gates.py": "by how much a result is late; that it is late follows from the run's state",
    "service/machine/dask_files.py": _CHANGE,
    "service/machine/remote_task.py": _CHANGE,
    "service/monitor/alarm.py": _STAMP,
    "service/monitor/figures.py": _FIGURE,
    "service/monitor/reporter.py": "time in which a runner's main loop hangs",
    "service/monitor/snapshot.py": "last word of a runner; a worker's sign of life",
    "service/people/accounts.py": "life of a one-time link",
    "service/people/control.py": "wait for a locked screen in control",
    "service/people/credentials.py": "tries of an address, service restarted",
    "service/people/person.py": _STAMP,
    "service/people/sessions.py": "life of a sign-in",
    "service/run_record.py": _FIGURE,
    "service/runner/leave.py": "a confirmation, by both clocks; tests/recovery/test_confirmation_lapses.py",
    "service/steps/held_camera.py": "a photograph of the step",
    "service/steps/coats.py": "age of the coat",
    "service/steps/kinds/scan_import.py": "an export of the step",
    "service/steps/due_jobs.py": _FIGURE,
    "service/store/durable_effects.py": "life of a sign-in; the clocks themselves",
    "service/store/backup.py": _STAMP,
    "service/store/database/database.py": "by which clock leases are judged",
    "service/store/objects/anchors.py": (
        "until when an anchor is locked, and the day of a root; times that the object store states"
    ),
    "service/store/verification/anchor_checks.py": "age of signatures without an anchor, against a patience of hours",
    "service/store/objects/spool.py": (
        "how much was recorded in the last hour, which is shown; "
        "since when no uploader has counted, which is shown; "
        "age of a file that may leave the spool; "
        "the object store has confirmed it"
    ),
    "service/store/objects/opening.py": "until when a tried object is locked",
    "service/store/objects/reading.py": "which fetched copy was used last",
    "service/store/objects/s3.py": "time of a signed request, which the object store judges",
    "service/store/objects/upload.py": _STAMP,
    "service/store/database/engine.py": _CHANGE,
    "service/store/database/migrations/versions/0001_evidence.py": _STAMP,
    "service/store/database/migrations/versions/0002_people_and_checkpoints.py": _STAMP,
    "service/store/database/new_schema.py": _STAMP,
    "service/store/database/tables.py": _STAMP,
    "service/store/events.py": _STAMP,
    "service/store/disk_space.py": "age of an unrecorded file",
    "service/store/verification/file_checks.py": "names of columns",
    "service/store/restoring.py": _STAMP,
    "service/store/jobs.py": "job's lease, its worker died on another host",
    "service/store/runs.py": "run's lease, its runner lives on another host",
    "service/store/records.py": _STAMP,
    "service/store/signatures/second_place.py": _STAMP,
    "service/store/signatures/signing.py": _STAMP,
    "service/store/signatures/timestamps.py": _STAMP,
    "service/store/store.py": _STAMP,
    "service/store/verification/chain_checks.py": "times that run backwards within a chain, which the audit notes",
    "service/store/verification/people_checks.py": "recorded times that must agree",
    "service/web/media.py": "age of a frame of the live view",
    "service/web/home.py": _STAMP,
    "service/web/charts.py": _STAMP,
    "service/web/robot_banner.py": "last word of a runner",
    "service/web/run_frame.py": "last word of a runner",
    "service/web/accounts.py": _STAMP,
    "service/web/run.py": "last word of a runner",
    "service/worker/following.py": "by how much a result is late; that it is late follows from the run's state",
}


def places() -> set[str]:
    """The files that look at UTC, at the time of a file or at that of the boot."""
    sources = [path for top in ("service", "drivers") for path in (REPOSITORY / top).rglob("*.py")]
    found = [path for path in sources if _LOOKS.search(path.read_text())]
    own = REPOSITORY / "service" / "audit" / "bundle_verifier.py"  # of a bundle, far from every host
    return {str(path.relative_to(REPOSITORY)) for path in found if path != own}
