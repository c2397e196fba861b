"""Kinds of jobs, declared once for steps, worker, audit and web; and the list of all kinds."""

from __future__ import annotations

from functools import cache
from typing import Any

from service.core.declared_kinds import declared_kinds
from service.core.loading import loading
from service.jobs.kind import JobKind

GROUP = "orthocapture.jobs"  # entry points of plug-ins; each names a JobKind


@cache
def job_kinds() -> dict[str, JobKind[Any, Any]]:
    """All job kinds by name, in the order in which a run uses them: those of this package, and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something that is not a JobKind.
    """
    with loading():
        kinds: dict[str, JobKind[Any, Any]] = declared_kinds(__name__, GROUP, JobKind)
    return dict(sorted(kinds.items(), key=lambda item: (item[1].order, item[0])))
