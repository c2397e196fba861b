"""Writes a process's log records to the data folder as JSON too; the terminal's output stays as it is."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator
from contextlib import contextmanager
from os import getpid
from pathlib import Path

import structlog
from structlog.typing import EventDict, WrappedLogger

from service.logs.bounded_file import BoundedFile
from service.logs.secrets import without_secrets
from service.logs.where import at, where_now

_LONGEST = 20_000  # characters of one text: the traceback of a deep recursion must not rotate the whole log away
_OURS = ("service", "drivers", "orthocapture")  # other libraries log too much below warnings
_CHILDREN = "drivers.host."  # loggers with which drivers.host passes on what a driver's process logs


@contextmanager
def file_log(
    data: Path,
    process: str,
    *,
    run: str = "",
    handler: BoundedFile | None = None,
    admits: Callable[[logging.LogRecord], bool] | None = None,
) -> Generator[None]:
    """Within this block, also write log records to `data`/logs: ours from INFO up, other libraries' from WARNING up.

    Args:
        data: the data folder; nothing is written until it exists.
        process: name written in every line: runner, worker, web …
        run: run id, also written in every line.
        handler: replaces the data folder's file.
        admits: decides for each record whether it is written; None: all are.
    """
    handler = handler or BoundedFile(data)
    handler.setFormatter(_formatter(process))
    if admits is not None:
        handler.addFilter(admits)
    root = logging.getLogger()
    before = root.level
    # The root level chose what the terminal shows; keep that choice on its handlers, since ours needs INFO.
    shown = [other for other in root.handlers if other.level < before]
    levels = [other.level for other in shown]
    for other in shown:
        other.setLevel(before)
    ours = [logging.getLogger(name) for name in _OURS]
    levels_of_ours = [logger.level for logger in ours]
    for logger in ours:
        logger.setLevel(min(before, logging.INFO))
    root.addHandler(handler)
    at(run=run)
    try:
        yield
    finally:
        at(run="", step="", viewpoint="", job="")
        root.removeHandler(handler)
        for logger, level in zip(ours, levels_of_ours, strict=True):
            logger.setLevel(level)
        for other, level in zip(shown, levels, strict=True):
            other.setLevel(level)
        handler.close()


def _formatter(process: str) -> logging.Formatter:
    def place(_logger: WrappedLogger, _method: str, line: EventDict) -> EventDict:
        name = str(line.get("logger", ""))
        child = name.removeprefix(_CHILDREN) if name.startswith(_CHILDREN) else ""
        whose = {"process": f"driver {child}" if child else process, "pid": getpid()}
        return {**where_now(), **line, **whose}

    return structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            structlog.stdlib.add_log_level,
            structlog.stdlib.add_logger_name,
            structlog.stdlib.ExtraAdder(),
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="at_utc"),
            place,
        ],
        processors=[
            structlog.stdlib.ProcessorFormatter.remove_processors_meta,
            structlog.processors.format_exc_info,  # leaves out the values of variables
            _shortened,
            _scrubbed,
            structlog.processors.JSONRenderer(ensure_ascii=False),
        ],
    )


def _shortened(_logger: WrappedLogger, _method: str, line: EventDict) -> EventDict:
    return {
        name: value[:_LONGEST] + " …" if isinstance(value, str) and len(value) > _LONGEST else value
        for name, value in line.items()
    }


def _scrubbed(_logger: WrappedLogger, _method: str, line: EventDict) -> EventDict:
    return {name: without_secrets(value, name) for name, value in line.items()}
