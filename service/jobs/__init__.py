"""What crosses between steps, worker, audit and web: one declaration per job kind, and the list of all kinds."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from service.core.errors import ConfigurationError
from service.jobs.kind import JobKind

GROUP = "orthocapture.jobs"  # entry points of plug-ins; each names a JobKind


@cache
def job_kinds() -> dict[str, JobKind[Any, Any]]:
    """All job kinds by name: every module below this package that defines KIND, and those of plug-ins.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something else than a JobKind.
    """
    names = [m.name for m in pkgutil.walk_packages(__path__, f"{__name__}.") if not m.ispkg]
    modules = [importlib.import_module(name) for name in names]
    declared: list[object] = [module.KIND for module in modules if hasattr(module, "KIND")]
    declared += [point.load() for point in entry_points(group=GROUP)]
    kinds: dict[str, JobKind[Any, Any]] = {}
    for kind in declared:
        if not isinstance(kind, JobKind):
            raise ConfigurationError(f"{kind!r} is no JobKind", where=f"entry points {GROUP}")
        if kind.name in kinds:
            raise ConfigurationError(f"two job kinds are called {kind.name!r}", where=f"entry points {GROUP}")
        kinds[kind.name] = kind
    return dict(sorted(kinds.items(), key=lambda item: (item[1].order, item[0])))
