"""Passes on what a driver's process logs and prints, under the name of its device."""

from __future__ import annotations

import logging
from subprocess import Popen

LOG = logging.getLogger("drivers.host")
_LEVELS = logging.getLevelNamesMapping()
# What other libraries than the driver's own package log in a child is for the log file, not for people.
_OURS = frozenset({"drivers", "service", "root"})


def pass_on(process: Popen[str], name: str, package: str) -> None:
    """Log each line that the process writes, until it ends; `package` is that of its driver."""
    log = logging.getLogger(f"{LOG.name}.{name}")
    assert process.stdout is not None
    for line in process.stdout:
        level, separator, message = line.rstrip().partition("|")
        if separator and level in _LEVELS:
            ours = message.partition(":")[0].partition(".")[0] in _OURS | {package}
            log.log(_LEVELS[level] if ours else min(_LEVELS[level], logging.INFO), "%s", message)
        elif line.strip():
            log.info("%s", line.rstrip())
