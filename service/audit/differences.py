"""Comparison of plain data and of files: where they differ, and by how much."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from service.core.geometry import Array
from service.core.records.base import ArtefactRef

# Relative to the largest number of a field: rounding that differs between processors and libraries. Predicted errors
# differ by 1e-8 between processors with and without AVX-512, which is 3e-9 mm of 0.3 mm.
TOLERANCE = 1e-7
_SHOWN = 200  # most differing fields kept of one comparison

# End of a name → unit in which the difference is shown, and the factor to it.
_UNITS: Mapping[str, tuple[str, float]] = {
    "_mm": ("mm", 1.0),
    "_px": ("px", 1.0),
    "_m": ("mm", 1e3),
    "_m2": ("mm²", 1e6),
    "_deg": ("°", 1.0),
    "_rad": ("°", 180 / math.pi),
    "_s": ("s", 1.0),
    "_lux": ("lx", 1.0),
}

_EXPLANATIONS = ("how", "verdict")  # of the error budget: explanations of numbers that are compared themselves


@dataclass(frozen=True, slots=True)
class Difference:
    """A field whose recomputed value differs from the recorded one; of an array, the value that differs most."""

    path: str
    recorded: Any
    recomputed: Any
    difference: float | None  # the difference in `unit`; None unless both are numbers
    relative: float | None  # relative to the largest number of the field
    unit: str
    values: int = 1  # number of values that differ
    added: bool = False  # true if what was recorded has no such field

    @property
    def wording(self) -> bool:
        """True if only the wording of an explanation differs: the numbers that it explains are compared."""
        texts = isinstance(self.recorded, str) and isinstance(self.recomputed, str)
        return texts and self.path.rpartition(".")[2] in _EXPLANATIONS

    @property
    def within_tolerance(self) -> bool:
        """True if at most rounding or the wording of an explanation differs."""
        return self.wording or (self.relative is not None and self.relative <= TOLERANCE)


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of a comparison."""

    compared: int = 0  # values
    differences: tuple[Difference, ...] = ()  # worst first

    @property
    def identical(self) -> bool:
        """True if recorded and recomputed data are bit-identical."""
        return not self.differences

    @property
    def equal(self) -> bool:
        """True if nothing but rounding or wording differs."""
        return all(d.within_tolerance for d in self.differences)

    def of_recorded(self) -> Comparison:
        """Return the comparison of the recorded fields, without those that only the recomputed data have."""
        return replace(self, differences=tuple(d for d in self.differences if not d.added))


@dataclass
class _Collector:
    renamed: Mapping[str, str]
    compared: int = 0
    found: dict[str, Difference] = field(default_factory=dict[str, Difference])

    def add(self, group: str, difference: Difference) -> None:
        before = self.found.get(group)
        if before is None:
            self.found[group] = difference
            return
        worst = max(before, difference, key=_badness)
        self.found[group] = Difference(
            worst.path,
            worst.recorded,
            worst.recomputed,
            worst.difference,
            worst.relative,
            worst.unit,
            before.values + difference.values,
            worst.added,
        )


def _badness(difference: Difference) -> float:
    return math.inf if difference.relative is None else difference.relative


def compare_data(
    recorded: Any, recomputed: Any, *, path: str = "", renamed: Mapping[str, str] | None = None
) -> Comparison:
    """Compare plain data (what JSON can hold) number by number.

    Args:
        recorded: the data in the evidence.
        recomputed: the data that the replay computed.
        path: prefix of every path.
        renamed: hashes of recomputed files: recorded → recomputed.
    """
    collector = _Collector(renamed or {})
    _walk(collector, recorded, recomputed, path, path)
    return _result(collector)


def _result(collector: _Collector) -> Comparison:
    worst_first = sorted(collector.found.values(), key=lambda d: (-_badness(d), d.path))
    return Comparison(collector.compared, tuple(worst_first[:_SHOWN]))


def _walk(out: _Collector, a: Any, b: Any, path: str, group: str) -> None:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        here, there = cast("Mapping[str, Any]", a), cast("Mapping[str, Any]", b)
        many = _is_table(here)
        for key in {**here, **there}:
            below, shown = _join(path, str(key)), _join(group, "*" if many else str(key))
            if key not in here or key not in there:
                missing = "nothing"
                old, new = _brief(here.get(key, missing)), _brief(there.get(key, missing))
                out.add(shown, Difference(below, old, new, None, None, "", added=key not in here))
            else:
                _walk(out, here[key], there[key], below, shown)
        return
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        one, other = cast("Sequence[Any]", a), cast("Sequence[Any]", b)
        numbers = _numbers(one), _numbers(other)
        if numbers[0] is not None and numbers[1] is not None and numbers[0].shape == numbers[1].shape:
            _arrays(out, numbers[0], numbers[1], path, group)
        elif len(one) != len(other):
            out.add(group, Difference(path, f"{len(one)} entries", f"{len(other)} entries", None, None, ""))
        else:
            for n, (x, y) in enumerate(zip(one, other, strict=True)):
                _walk(out, x, y, f"{path}[{n}]", f"{group}[*]")
        return
    out.compared += 1
    if _is_number(a) and _is_number(b):
        if a != b:
            out.add(group, _scalar(float(cast("float", a)), float(cast("float", b)), path))
    elif type(a) is not type(b) or (a != b and out.renamed.get(str(a)) != b):
        out.add(group, Difference(path, _brief(a), _brief(b), None, None, ""))


def _arrays(out: _Collector, a: Array, b: Array, path: str, group: str) -> None:
    out.compared += a.size
    if np.array_equal(a, b, equal_nan=True):
        return
    if _is_pose(path) and a.shape[-2:] == (4, 4):
        for rows, name, unit, factor in (
            ((..., slice(0, 3), slice(3, 4)), "translation", "mm", 1e3),
            ((..., slice(0, 3), slice(0, 3)), "rotation", "°", 180 / math.pi),
        ):
            _one_array(out, a[rows], b[rows], f"{path} {name}", f"{group} {name}", (unit, factor), least_scale=1.0)
        _one_array(out, a[..., 3, :], b[..., 3, :], f"{path} last row", f"{group} last row", ("", 1.0))
        return
    _one_array(out, a, b, path, group, unit_of(path))


def _one_array(
    out: _Collector, a: Array, b: Array, path: str, group: str, unit: tuple[str, float], least_scale: float = 0.0
) -> None:
    """Compare two arrays. `least_scale`: smallest scale of the tolerance, because a pose may be at the origin."""
    apart = (a != b) & ~(np.isnan(a) & np.isnan(b))
    if not apart.any():
        return
    off = np.where(apart, np.abs(b - a), 0.0)
    off[np.isnan(off)] = np.inf
    at = np.unravel_index(int(np.argmax(off)), a.shape)
    scale = max(least_scale, float(np.abs(np.where(np.isfinite(a), a, 0.0)).max()))
    worst = float(off[at])
    relative = worst / scale if scale > 0 else math.inf
    index = "".join(f"[{n}]" for n in at)
    out.add(
        group,
        Difference(
            f"{path}{index}", float(a[at]), float(b[at]), worst * unit[1], relative, unit[0], int(apart.sum())
        ),
    )


def _scalar(a: float, b: float, path: str) -> Difference:
    unit, factor = unit_of(path)
    off = abs(b - a)
    return Difference(path, a, b, off * factor, off / max(abs(a), abs(b)), unit)


def unit_of(path: str) -> tuple[str, float]:
    """Return the unit to show and the factor to it, by the last name in a path that has one."""
    for name in reversed(re.split(r"[.\[\] ]+", path)):
        for ending in sorted(_UNITS, key=len, reverse=True):
            if name.endswith(ending):
                return _UNITS[ending]
    return "", 1.0


def _is_pose(path: str) -> bool:
    return any(part.startswith("T_") for part in re.split(r"[.\[\]]+", path)[-3:])


def _is_table(mapping: Mapping[str, Any]) -> bool:
    """Return whether a mapping has many entries of one type, such as viewpoints, and so counts as one field."""
    kinds = {type(value) for value in mapping.values()}
    return len(mapping) > 5 and len(kinds) == 1 and kinds <= {list, tuple, dict}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(values: Sequence[Any]) -> Array | None:
    """Return nested lists of numbers as an array, or None."""
    if not _only_numbers(values):
        return None
    try:
        return np.array(values, dtype=np.float64)
    except ValueError:  # rows of different lengths
        return None


def _only_numbers(values: Any) -> bool:
    if isinstance(values, list | tuple):
        return len(cast("Sequence[Any]", values)) > 0 and all(map(_only_numbers, cast("Sequence[Any]", values)))
    return _is_number(values)


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _brief(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float):
        return value
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 80 else text[:79] + "…"


# --- files --------------------------------------------------------------------------------------------------


def compare_files(
    ref: ArtefactRef, recorded: Path, recomputed: Path, *, renamed: Mapping[str, str] | None = None
) -> Comparison:
    """Compare the contents of two files of one kind: JSON by its numbers, arrays, pictures by their pixels."""
    name = ref.original_name
    if ref.media_type == "application/json":
        pair = (json.loads(path.read_bytes()) for path in (recorded, recomputed))
        return compare_data(*pair, path=name, renamed=renamed)
    if name.endswith(".npz"):
        return _compare_archives(name, recorded, recomputed)
    if ref.media_type.startswith("image/"):
        return _compare_pictures(name, recorded, recomputed)
    sizes = f"{recorded.stat().st_size} bytes", f"{recomputed.stat().st_size} bytes"
    return Comparison(1, (Difference(name, *sizes, None, None, ""),))


def _compare_archives(name: str, recorded: Path, recomputed: Path) -> Comparison:
    out = _Collector({})
    old, new = (dict(_arrays_of(path)) for path in (recorded, recomputed))
    for key in {**old, **new}:
        path = f"{name}: {key}"
        if key not in old or key not in new or old[key].shape != new[key].shape:
            before, after = (f"shape {found[key].shape}" if key in found else "nothing" for found in (old, new))
            out.add(path, Difference(path, before, after, None, None, ""))
        elif old[key].dtype.kind in "fiub":
            pair = old[key].astype(np.float64), new[key].astype(np.float64)
            out.compared += pair[0].size
            _one_array(out, *pair, path, path, unit_of(key))
        elif not np.array_equal(old[key], new[key]):
            out.add(path, Difference(path, _brief(str(old[key])), _brief(str(new[key])), None, None, ""))
    return _result(out)


def _arrays_of(path: Path) -> Iterator[tuple[str, Any]]:
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
        for key in archive.files:
            yield key, archive[key]


def _compare_pictures(name: str, recorded: Path, recomputed: Path) -> Comparison:
    old, new = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (recorded, recomputed))
    if old is None or new is None or old.shape != new.shape:
        before, after = (
            "unreadable" if p is None else "×".join(map(str, p.shape[1::-1])) + " px" for p in (old, new)
        )
        return Comparison(1, (Difference(f"{name} size", before, after, None, None, ""),))
    off = np.abs(old.astype(np.float64) - new.astype(np.float64))
    worst = float(off.max())
    if worst == 0:
        return Comparison(off.size, ())
    path = f"{name}: pixels, mean difference {off.mean():.3g}"
    at = np.unravel_index(int(off.argmax()), off.shape)
    entry = Difference(
        path, float(old[at]), float(new[at]), worst, worst / 255, "levels of 255", int((off > 0).sum())
    )
    return Comparison(off.size, (entry,))
