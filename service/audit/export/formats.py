"""The registered formats, listed by a process of its own: they load the numerics, which a web process does without.

`python -m service.audit.export.formats`
"""

from __future__ import annotations

from dataclasses import dataclass

from service.audit.background.child_process import ChildProcesses, ChildState, Progress, report
from service.store.durable_effects import Clock

_KEY = ""  # the list belongs to no run


@dataclass(frozen=True, slots=True)
class Format:
    """A format: its name, and what it is in words."""

    name: str
    words: str


class Formats:
    """The formats that this installation has."""

    def __init__(self, clock: Clock) -> None:
        self._children = ChildProcesses("service.audit.export.formats", "list of formats", clock)

    def state(self) -> ChildState | None:
        """The progress or the outcome of the listing; None before it was begun."""
        return self._children.state(_KEY)

    def known(self, wait_s: float = 0.0) -> tuple[Format, ...]:
        """The formats in the order of their names; empty while they are not known. Begins to list them once."""
        if self.state() is None:
            self._children.start(_KEY, (), by="")
        if wait_s:
            self._children.wait(_KEY, wait_s)
        now = self.state()
        return tuple(Format(**row) for row in (now.result or () if now else ()))


def listed(_progress: Progress) -> list[dict[str, str]]:
    """The formats as plain data. Raises ConfigurationError."""
    from service.dataset.exporter import exporters  # noqa: PLC0415 - see above

    return [{"name": name, "words": how.words} for name, how in sorted(exporters().items())]


if __name__ == "__main__":
    report(listed, outlives_parent=False)
