"""A mapping that is never changed but grows cheaply: what the fold of ten thousand events adds to, one by one."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Value = TypeVar("Value")


@dataclass(slots=True)
class _Shared(Generic[Value]):
    """What all versions of a mapping have in common: each key's values with the version that brought them."""

    values: dict[str, list[tuple[int, Value]]] = field(default_factory=dict[str, list[tuple[int, Value]]])
    newest: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


class PersistentMap(Mapping[str, Value]):
    """As a dict whose items stay as they are; `put` gives the next version in constant time.

    A dict that is copied for every event makes the fold of a run take the square of the run's length. Versions share
    their items, and each sees those that were there when it was made. Only one that is not the newest is copied.
    """

    __slots__ = ("_length", "_shared", "_version")

    def __init__(self, items: Mapping[str, Value] | None = None) -> None:
        shared = _Shared[Value]()
        for key, value in (items or {}).items():
            shared.values[key] = [(0, value)]
        self._shared, self._version, self._length = shared, 0, len(shared.values)

    def put(self, key: str, value: Value) -> PersistentMap[Value]:
        """The same with `value` under `key`: a new key comes last, a known one keeps its place."""
        shared = self._shared
        with shared.lock:
            if shared.newest == self._version:
                shared.newest += 1
                shared.values.setdefault(key, []).append((shared.newest, value))
                return self._next(shared, self._length + (key not in self))
        return PersistentMap({**self, key: value})

    @classmethod
    def _next(cls, shared: _Shared[Value], length: int) -> PersistentMap[Value]:
        following = cls.__new__(cls)
        following._shared, following._version, following._length = shared, shared.newest, length
        return following

    def __getitem__(self, key: str) -> Value:
        """The value as of this version. Raises KeyError."""
        for version, value in reversed(self._shared.values[key]):
            if version <= self._version:
                return value
        raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        """The keys of this version in the order in which they came."""
        return iter([key for key in list(self._shared.values) if key in self])

    def __len__(self) -> int:
        """How many keys this version has."""
        return self._length

    def __repr__(self) -> str:
        """As of a dict."""
        return f"PersistentMap({dict(self)!r})"

    def __reduce__(self) -> tuple[type[PersistentMap[Value]], tuple[dict[str, Value]]]:
        """A copy in another process is a mapping of its own."""
        return PersistentMap, (dict(self),)


def put(items: Mapping[str, Value], key: str, value: Value) -> PersistentMap[Value]:
    """`items` with `value` under `key`; constant time where they grew so before."""
    return (items if isinstance(items, PersistentMap) else PersistentMap(items)).put(key, value)
