"""The rules by which every case is judged, independent of its fault, instead of expectations per case."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from drivers import errors as _device_errors
from service.core.errors import OrthocaptureError
from service.core.records.events import Event
from service.core.records.run_events import (
    DeviceOpened,
    OperatorAction,
    StepFailed,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.store.verification.verify import verify
from tests.support.torture.faults.place.person import Motions

_SAYS = re.compile(r"^.+ \[[^\]]+\]\. .+$", re.DOTALL)  # what, [place], remedy
_NOTICE_S = 0.1  # between a motion and a sample of it, or a stop and its sample
_TRACES = ("Traceback (most recent call last)", "Exception in thread", "Exception ignored in")
assert _device_errors.DeviceError  # imported so that its subclasses are known


def broken(
    events: Sequence[Event], motions: Motions, data: Path, views: Iterable[str], status: str, logs: Iterable[Path]
) -> list[str]:
    """Return the violated rules, as sentences."""
    return [
        *_words(events),
        *_views(events, tuple(views), status),
        *_surprises(events, motions),
        *(f"audit verify: {fault}" for fault in verify(data).faults),
        *_traces(logs),
    ]


def tells(message: str) -> bool:
    """Return whether a message names a place and a remedy."""
    return _SAYS.match(message) is not None


def _known() -> set[str]:
    """The names of all classes of the error tree."""
    names: set[str] = set()
    classes: list[type[OrthocaptureError]] = [OrthocaptureError]
    while classes:
        one = classes.pop()
        names.add(one.__name__)
        classes += one.__subclasses__()
    return names


def _words(events: Sequence[Event]) -> list[str]:
    known, found = _known(), list[str]()
    for event in events:
        payload = event.payload
        if not isinstance(payload, StepFailed | ViewpointFailed):
            continue
        if payload.error not in known:
            found.append(f"{payload.error} is not of the error tree: {payload.message}")
        if "driver raised" in payload.message:
            found.append(f"an exception that the driver does not know: {payload.message}")
        if not tells(payload.message):
            found.append(f"no place or no remedy: {payload.error}: {payload.message}")
    return list(dict.fromkeys(found))


def _views(events: Sequence[Event], views: tuple[str, ...], status: str) -> list[str]:
    """Faults if a viewpoint is missing, or repeated although its image was not rejected by its own verdicts."""
    good = Counter[str]()
    found: list[str] = []
    for event in events:
        payload = event.payload
        if not isinstance(payload, ViewpointCaptured):
            continue
        if not payload.artefacts or any(len(ref.sha256) != 64 for ref in payload.artefacts):
            found.append(f"{payload.viewpoint} is recorded without its file")
        if all(payload.verdicts.values()):
            good[payload.viewpoint] += 1
    found += [f"{name} is recorded {count} times" for name, count in good.items() if count > 1]
    given_up = {e.payload.viewpoint for e in events if isinstance(e.payload, ViewpointFailed) and e.payload.skipped}
    if status == "completed":
        found += [f"{name} is not in the record" for name in views if not good[name] and name not in given_up]
    return found


def _surprises(events: Sequence[Event], motions: Motions) -> list[str]:
    """Motions without a confirmation since the last stop, and since the last connection to the arm."""
    connections: dict[int, set[int]] = {}
    found: list[str] = []
    for moment in motions.begun_s:
        before = [event for event in events if event.monotonic_s < moment]
        let = [e for e in before if isinstance(e.payload, OperatorAction) and e.payload.action in ("confirm", "redo")]
        if not let:
            found.append("the arm moved, and nobody had confirmed")
            continue
        stops = [at_s for at_s in motions.stopped_s if at_s < moment - _NOTICE_S]
        if stops and max(stops) > let[-1].monotonic_s:
            found.append("the arm moved after a stop, and nobody had confirmed since")
        opened = sum(isinstance(e.payload, DeviceOpened) and e.payload.device == "robot" for e in before)
        connections.setdefault(let[-1].seq, set()).add(opened)
    found += [
        "the arm moved after a reconnection, and nobody had confirmed since"
        for used in connections.values()
        if len(used) > 1
    ]
    return list(dict.fromkeys(found))


def _traces(logs: Iterable[Path]) -> list[str]:
    """Faults for tracebacks in the logs: nobody may be shown the program's internals."""
    found: list[str] = []
    for log in logs:
        if log.exists():
            text = log.read_text(errors="replace")
            for trace in _TRACES:
                at = text.find(trace)
                if at >= 0:
                    lines = [line for line in text[at : at + 6000].splitlines() if line.strip()]
                    last = next((line for line in lines[1:] if not line.lstrip().startswith(("File", "^", "~"))
                                 and re.search(r"(Error|Exception|Interrupt)\b", line)), lines[-1])  # fmt: skip
                    found.append(f"a traceback in {log.name}: {last.strip()[:200]}")
    return found
