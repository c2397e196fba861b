"""Wait, at the end of a run, for the results that are still being computed, and show the time left."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager

from service.cli.run.terminal.operators import Display
from service.core.protocol.models import Protocol
from service.run_record import RunFollower, results_to_come
from service.steps.due_jobs import duration_words
from service.store.store import Store

_LOOK_S = 2.0  # reading a whole run takes a sixth of a second, which the computation also needs


def wait_for_results(store: Store, run_id: str, protocol: Protocol, display: Display) -> None:
    """Show what is still being computed until all is done; Ctrl-C leaves it to another worker and loses nothing."""
    run = RunFollower(store, run_id, protocol)
    pending = [one for one in results_to_come(run.now()) if not one.failed]
    if not pending or not store.open_jobs(run_id):
        return
    display.tell("The run is complete. Results for comparison are still being computed; Ctrl-C leaves them for later")
    seen: set[str] = set()
    total = len(pending)
    try:
        with _told_to_leave() as leave:
            while store.open_jobs(run_id) and not leave.is_set():
                left = results_to_come(run.now())
                for one in left:
                    if one.failed and one.name not in seen:
                        seen.add(one.name)
                        display.tell(one.text)
                pending = [one for one in left if not one.failed]
                last_s = max((one.seconds for one in pending), default=0.0)
                names = ", ".join(one.name for one in pending[:3]) + (" …" if len(pending) > 3 else "")
                display.show(
                    f"{names or 'computing'}: about {duration_words(last_s)} left", total - len(pending), total
                )
                leave.wait(_LOOK_S)
    finally:
        display.clear()
    if leave.is_set():
        data = store.database_path.parent
        display.tell(f"Left for later: `orthocapture worker --data {data} --until-idle` computes what is missing")


@contextmanager
def _told_to_leave() -> Generator[threading.Event]:
    """An event set by Ctrl-C and SIGTERM; an exception could get lost in a finaliser or callback."""
    leave = threading.Event()
    before = {number: signal.signal(number, lambda *_: leave.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield leave
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
