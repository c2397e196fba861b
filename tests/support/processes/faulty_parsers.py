"""A group of fuzz targets whose parsers have every kind of fault that the sweep is meant to find."""

from __future__ import annotations

import ctypes
import time
from pathlib import Path

from service.core.errors import DataError
from tests.support.torture.fuzz.mutations import flip
from tests.support.torture.fuzz.targets.target import Target

_KEPT: list[bytes] = []


def _seeds(_: Path) -> list[bytes]:
    return [b"plain" * 4]


def _spoilt(data: bytes) -> bool:
    return data != b"plain" * 4


def _crash(data: bytes, _: Path) -> None:
    if _spoilt(data):
        ctypes.string_at(0)


def _hang(data: bytes, _: Path) -> None:
    while _spoilt(data):
        time.sleep(0.01)  # only the clock tells this from an endless computation


def _grow(data: bytes, _: Path) -> None:
    if _spoilt(data):
        _KEPT[:] = [bytes(range(256)) * (1 << 18)]


def _leak(data: bytes, _: Path) -> None:
    if _spoilt(data):
        data.decode("ascii")
        raise ValueError("a library's own")


def _mumble(data: bytes, _: Path) -> None:
    if _spoilt(data):
        raise DataError("something is wrong")


def _refuse(data: bytes, folder: Path) -> None:
    if _spoilt(data):
        raise DataError("the file is spoilt", where=str(folder / "file"), remedy="Export it again")


TARGETS: tuple[Target, ...] = tuple(
    Target(
        parse.__name__,
        f"tests.support.processes.faulty_parsers:{parse.__name__}",
        parse,
        _seeds,
        (flip,),
        memory_mib=32,
    )
    for parse in (_crash, _hang, _grow, _leak, _mumble, _refuse)
)
