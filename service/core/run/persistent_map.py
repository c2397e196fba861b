"""An immutable mapping that grows cheaply: the fold of ten thousand events adds to it one item at a time."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Value = TypeVar("Value")


@dataclass(slots=True)
class _Versions(Generic[Value]):
    """The part that all versions of a mapping share: the values of each key, with the version that added each."""

    values: dict[str, list[tuple[int, Value]]] = field(default_factory=dict[str, list[tuple[int, Value]]])
    newest: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


class PersistentMap(Mapping[str, Value]):
    """An immutable dict; `put` returns the next version in constant time.

    Copying a dict for every event would make the fold of a run quadratic in its length. Instead, versions share their
    items, and each version sees those that existed when it was made. `put` copies only if called on an old version.
    """

    __slots__ = ("_length", "_shared", "_version")

    def __init__(self, items: Mapping[str, Value] | None = None) -> None:
        shared = _Versions[Value]()
        for key, value in (items or {}).items():
            shared.values[key] = [(0, value)]
        self._shared, self._version, self._length = shared, 0, len(shared.values)

    def put(self, key: str, value: Value) -> PersistentMap[Value]:
        """Return a new version with `value` under `key`; a new key comes last, an existing one keeps its place."""
        shared = self._shared
        with shared.lock:
            if shared.newest == self._version:
                shared.newest += 1
                shared.values.setdefault(key, []).append((shared.newest, value))
                return self._next(shared, self._length + (key not in self))
        return PersistentMap({**self, key: value})

    @classmethod
    def _next(cls, shared: _Versions[Value], length: int) -> PersistentMap[Value]:
        following = cls.__new__(cls)
        following._shared, following._version, following._length = shared, shared.newest, length
        return following

    def __getitem__(self, key: str) -> Value:
        """Return the value of `key` in this version. Raises KeyError."""
        for version, value in reversed(self._shared.values[key]):
            if version <= self._version:
                return value
        raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        """Return the keys of this version in order of insertion."""
        return iter([key for key in list(self._shared.values) if key in self])

    def __len__(self) -> int:
        """Return the number of keys in this version."""
        return self._length

    def __repr__(self) -> str:
        """Return `PersistentMap({…})` with the items of this version."""
        return f"PersistentMap({dict(self)!r})"

    def __reduce__(self) -> tuple[type[PersistentMap[Value]], tuple[dict[str, Value]]]:
        """Pickle as an independent mapping with the items of this version."""
        return PersistentMap, (dict(self),)


def put(items: Mapping[str, Value], key: str, value: Value) -> PersistentMap[Value]:
    """Return `items` with `value` under `key`; in constant time for the newest version of a PersistentMap."""
    return (items if isinstance(items, PersistentMap) else PersistentMap(items)).put(key, value)
