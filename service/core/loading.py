"""Loading many modules at once, without looking for garbage among them; for the start of a process.

Python's collector would visit all objects of all loaded modules again and again, a hundred times in half a second,
though no module is garbage: a sixth of what a command costs to start. So it rests while modules are loaded, and then
leaves alone for ever what was loaded.
"""

from __future__ import annotations

import gc
from collections.abc import Generator
from contextlib import contextmanager


def begin_loading() -> None:
    """Let the collector rest, from the first line of a program until `end_loading`."""
    gc.disable()


def end_loading() -> None:
    """Let the collector work again, on what is made from now on; without effect unless it rests."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


@contextmanager
def loading() -> Generator[None]:
    """Import many modules inside this, once in a process: what exists then is never collected."""
    if not gc.isenabled():  # whoever started it will end it
        yield
        return
    begin_loading()
    try:
        yield
    finally:
        end_loading()
