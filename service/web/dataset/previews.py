"""The previews of data sets: made in the background when a page asks for one, kept in DIR/cache."""

from __future__ import annotations

from pathlib import Path
from threading import Lock
from typing import Annotated

from fastapi import Depends, Request

from service.audit.background import ChildProcesses, ChildState
from service.core.run.state import RunState
from service.dataset.preview_records import FILE_NAME, Preview, read_preview
from service.store.durable_effects import Clock
from service.web.site import CurrentSite

_VERSION = "3"  # of what a preview holds
_LOCK = Lock()


class Previews:
    """The previews of one data folder."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._children = ChildProcesses("service.web.dataset.process", "preview", clock)

    def ready(self, state: RunState) -> Preview | None:
        """What is ready of a completed run's preview. Begins to make it where nobody has; None: nothing is ready."""
        found = read_preview(self._folder(state))
        if (found is None or not found.whole) and self._children.state(state.run_id) is None:
            self.make(state)
        return found

    def making(self, run_id: str) -> ChildState | None:
        """The progress or the outcome of making the preview; None before the first time."""
        return self._children.state(run_id)

    def make(self, state: RunState) -> None:
        """Make the preview of a completed run, unless that is under way."""
        arguments = [str(self._data), state.run_id, str(self._folder(state))]
        self._children.start(state.run_id, arguments, by="")

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Wait until the making has ended."""
        self._children.wait(run_id, timeout_s)

    def file(self, state: RunState, name: str) -> Path | None:
        """A file of the preview; None for a name that it does not have."""
        path = self._folder(state) / name
        return path if FILE_NAME.fullmatch(name) and path.is_file() else None

    def _folder(self, state: RunState) -> Path:
        # What a preview shows of a completed run cannot change: its registration was signed, its scan is evidence.
        return self._data / "cache" / "dataset" / f"{state.run_id}-{state.completed_sha256[:16]}-{_VERSION}"


def _previews(request: Request, site: CurrentSite) -> Previews:
    state = request.app.state
    with _LOCK:
        if not hasattr(state, "previews"):
            state.previews = Previews(site.data, site.store.clock)
        found: Previews = state.previews
    return found


CurrentPreviews = Annotated[Previews, Depends(_previews)]
