"""The computations: each kind of job has a folder, declared in its `__init__.py` and computed in its `compute.py`.

`fuse/__init__.py` holds what steps, pages and audit read of the kind `fuse`: its arguments, its answer and its
`KIND`; it loads no numerics. `fuse/compute.py` holds the function that a worker or a replay calls. The modules beside
the folders are what several kinds share: `kind.py` and `records.py` for declarations, the others for computations.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from service.computations.kind import JobKind
from service.core.loading import KindsOnDemand

GROUP = "orthocapture.jobs"  # entry points of plug-ins; each names a JobKind


@cache
def job_kinds() -> Mapping[str, JobKind[Any, Any]]:
    """Return all job kinds by name, as a run uses them one after the other: this package's and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something that is not a JobKind; also
            when they are listed.
    """
    return KindsOnDemand[JobKind[Any, Any]](__name__, GROUP, JobKind, lambda kind: (kind.order, kind.name))


# Labels of names that are not job kinds; each job kind declares its own label.
_WORDS: Mapping[str, str] = {"ct": "CT series", "control_image": "images of the control spheres"}


def term(name: str) -> str:
    """Return the label of a name in the records: `CT surface` for ct_surface; an unknown name with spaces."""
    kind = job_kinds().get(name)
    return kind.words if kind is not None else _WORDS.get(name, name.replace("_", " "))
