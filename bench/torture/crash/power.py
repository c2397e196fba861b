"""Simulates a loss of power: removes from a data folder whatever the journals do not show as synced."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from service.store.database.engine import database_path
from tests.support.processes.mortal_files import read_journal


@dataclass
class _Unsynced:
    """Changes that may not have reached the disk.

    Attributes:
        data: file → the number of its leading bytes that are certainly on the disk.
        names: name → the file's previous name; None for a new file or folder.
        removed: name → where its content is kept.
        torn: where an unreturned commit begins and ends in the database's log.
    """

    data: dict[Path, int] = field(default_factory=dict[Path, int])
    names: dict[Path, Path | None] = field(default_factory=dict[Path, "Path | None"])
    removed: dict[Path, Path] = field(default_factory=dict[Path, Path])
    torn: tuple[int, int] | None = None


def lose_power(data: Path, journals: Iterable[Path], rng: Random) -> list[str]:
    """Undo unsynced changes, all or a random part of them; returns sentences that say what was undone.

    Every process must have ended. SQLite's shared memory is deleted too, and its log loses what an unreturned commit
    has written.
    """
    lines = sorted((line for journal in journals for line in read_journal(journal)), key=lambda line: line["at_ns"])
    unsynced = _Unsynced()
    for line in lines:
        _replay(unsynced, line)
    share = rng.choice((0.0, 0.5, 0.5, 1.0))  # fraction that survives
    taken: list[str] = []
    for path, aside in unsynced.removed.items():
        if aside.exists() and path.parent.exists() and not path.exists() and rng.random() >= share:
            os.link(aside, path)
            taken.append(f"the removal of {path.name}")
    for path, certain in unsynced.data.items():
        if path.is_file() and rng.random() >= share:
            taken.append(_spoil(path, certain, rng))
    for path, before in sorted(unsynced.names.items(), key=lambda item: -len(item[0].parts)):
        if path.exists() and rng.random() >= share:
            taken.append(_undo(path, before, rng))
    Path(f"{database_path(data)}-shm").unlink(missing_ok=True)
    if unsynced.torn is not None:
        log, (low, high) = Path(f"{database_path(data)}-wal"), unsynced.torn
        # If another process has committed since, its sync has brought this commit to the disk too.
        if log.exists() and log.stat().st_size == high > low:
            os.truncate(log, rng.randint(low, high))
            taken.append("a part of the commit")
    return taken


def _replay(unsynced: _Unsynced, line: dict[str, Any]) -> None:
    if "torn" in line:
        unsynced.torn = tuple(line["torn"])
    if "path" not in line:
        return
    path, moment = Path(line["path"]), (line["effect"], line["where"])
    match moment:
        case ("write", "before"):
            unsynced.names[path], unsynced.data[path] = None, 0
        case ("append", "before"):
            unsynced.data[path] = min(line["offset"], unsynced.data.get(path, line["offset"]))
        case ("make_directory", "before") if line["new"]:
            unsynced.names[path] = None
        case ("sync_file", "after"):
            unsynced.data.pop(path, None)
        case ("rename", "before"):  # a process killed from outside may have got as far as this
            source = Path(line["source"])
            unsynced.names[path] = source
            if source in unsynced.data:
                unsynced.data[path] = unsynced.data[source]
        case ("rename", "after"):
            source = Path(line["source"])
            unsynced.names.pop(source, None)
            unsynced.data.pop(source, None)
        case ("remove", "before"):
            unsynced.removed[path] = Path(line["aside"])
        case ("sync_directory", "after"):
            unsynced.names = {name: was for name, was in unsynced.names.items() if name.parent != path}
            unsynced.removed = {name: aside for name, aside in unsynced.removed.items() if name.parent != path}
        case _:
            pass


def _spoil(path: Path, certain: int, rng: Random) -> str:
    """Spoil content that was not synced: delete it, truncate it or fill it with zeros."""
    size, mode = path.stat().st_size, path.stat().st_mode
    path.chmod(0o600)
    keep = rng.randint(min(certain, size), size)
    how = rng.choice(("missing", "cut", "zeros"))
    if how == "zeros":
        content = path.read_bytes()
        path.write_bytes(content[:keep] + bytes(size - keep))
    else:
        os.truncate(path, min(certain, size) if how == "missing" else keep)
    path.chmod(mode)
    return f"content of {path.name} ({how})"


def _undo(path: Path, before: Path | None, rng: Random) -> str:
    """Undo an unsynced name: a new file disappears, a renamed file may return to its old name."""
    if path.is_dir():
        shutil.rmtree(path)
        return f"folder {path.name}"
    if before is not None and before.parent.exists() and rng.random() < 0.5:
        path.rename(before)
        return f"rename to {path.name}"
    path.unlink()
    return f"name {path.name}"
