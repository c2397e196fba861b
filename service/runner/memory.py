"""Garbage collection in the runner's process, in pauses too short to miss a heartbeat.

During a full collection no other thread of the process runs, not even the heartbeat without which a moving arm is
stopped after 0.2 s. A full collection visits every object in memory, and the runner keeps the events of its run: its
collections became longer with every viewpoint.
"""

from __future__ import annotations

import gc
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any


@contextmanager
def short_collections() -> Generator[None]:
    """Within this block, a full collection visits only what was made since the one before.

    What was there before, or survives a full collection, is not visited again. It is still freed when its last
    reference goes; only a cycle that becomes garbage later stays in memory, until the end of the block.
    """
    gc.freeze()
    gc.callbacks.append(_keep_survivors)
    try:
        yield
    finally:
        gc.callbacks.remove(_keep_survivors)
        gc.unfreeze()


def _keep_survivors(phase: str, collection: dict[str, Any]) -> None:
    if phase == "stop" and collection["generation"] == 2:
        gc.freeze()
