"""The computations: each folder declares kinds of jobs in its `__init__.py` and computes them in its `compute.py`.

`fuse/__init__.py` holds what steps, pages and audit read of the kind `fuse`: its arguments, its answer and its
`KIND`; it loads no numerics. `fuse/compute.py` holds the function that a worker or a replay calls. Kinds of one
subject share a folder: `image_poses` declares `features`, `match` and two more in its `KINDS`. The modules beside the
folders are what several kinds share: `kind.py` and `records.py` for declarations, the others for computations.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from service.computations.kind import JobKind
from service.core.loading import KindsOnDemand

GROUP = "orthocapture.jobs"  # entry points of plug-ins; each names a JobKind
SHARED_FOLDERS: Mapping[str, tuple[str, ...]] = {
    "calibration": ("board_view", "calibrate"),
    "scans": ("ct_surface", "locate_spheres", "merge_scans"),
    "image_poses": ("features", "match", "structure_from_motion", "hybrid"),
    "hand_held": ("hand_view", "hand_board"),
    "live": ("coverage_points", "live_view", "live_summary"),
    "further_cameras": ("develop", "further_camera", "further_view"),
    "registration": ("detect_spheres", "register"),
}  # the kinds of each folder that declares several; any other kind has the folder of its name


@cache
def job_kinds() -> Mapping[str, JobKind[Any, Any]]:
    """Return all job kinds by name, as a run uses them one after the other: this package's and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something that is not a JobKind; also
            when they are listed.
    """
    return KindsOnDemand[JobKind[Any, Any]](
        __name__, GROUP, JobKind, lambda kind: (kind.order, kind.name), SHARED_FOLDERS
    )


# Labels of names that are not job kinds; each job kind declares its own label.
_WORDS: Mapping[str, str] = {"ct": "CT series", "control_image": "images of the control spheres"}


def term(name: str) -> str:
    """Return the label of a name in the records: `CT surface` for ct_surface; an unknown name with spaces."""
    kind = job_kinds().get(name)
    return kind.words if kind is not None else _WORDS.get(name, name.replace("_", " "))
