"""Limits open event streams: a new one is always accepted, and the oldest of the same sign-in is closed for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(eq=False, slots=True)
class OpenStream:
    """The event stream of one page."""

    screen: str
    replaced: bool = False  # it is to say so and to end


class OpenStreams:
    """All streams of a server, oldest first. Used in the thread of its event loop alone.

    A page that was loaded again, or a tablet that dropped out, leaves a stream behind for a while. Were the new one
    refused, the person would be without news: so it replaces the oldest of its sign-in, or of the one that has most.
    """

    def __init__(self, *, per_screen: int = 6, in_all: int = 60) -> None:
        self._per_screen = per_screen
        self._in_all = in_all
        self._open: list[OpenStream] = []

    @contextmanager
    def opened(self, screen: str) -> Generator[OpenStream]:
        """A place among the streams of a sign-in, for as long as it lasts."""
        count = Counter(stream.screen for stream in self._open)
        if count[screen] >= self._per_screen:
            self._end_oldest(screen)
        elif len(self._open) >= self._in_all:
            self._end_oldest(max(count, key=lambda each: count[each]))
        stream = OpenStream(screen)
        self._open.append(stream)
        try:
            yield stream
        finally:
            if stream in self._open:
                self._open.remove(stream)

    def _end_oldest(self, screen: str) -> None:
        oldest = next(stream for stream in self._open if stream.screen == screen)
        oldest.replaced = True
        self._open.remove(oldest)
