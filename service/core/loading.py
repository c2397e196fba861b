"""Loads modules: many at once at the start of a process, and the kinds that modules and plug-ins declare once.

Python's collector would visit all objects of all loaded modules again and again, a hundred times in half a second,
though no module is garbage: a sixth of what a command costs to start. So it rests while modules are loaded, and then
leaves alone for ever what was loaded. A kind is declared once, as KIND or in KINDS of a module.
"""

from __future__ import annotations

import gc
import importlib
import os
import pkgutil
import sys
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, distributions
from types import ModuleType
from typing import Any, Protocol, TypeVar

from service.core.errors import ConfigurationError


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


class DeclaredKind(Protocol):
    """The least that every kind has."""

    @property
    def name(self) -> str:
        """The kind's name in protocols and records."""
        ...


K = TypeVar("K", bound=DeclaredKind)
_NONE_SHARED: Mapping[str, tuple[str, ...]] = {}


def declared_kinds(package: str, group: str, kind: type[K]) -> dict[str, K]:
    """Return the kinds of this type by name: KIND or KINDS of each module in `package`, and those of entry points.

    Args:
        package: the name of a package, whose folders are searched, or its modules if it has no folders; or the name
            of one module.
        group: the group of entry points, each of which names a kind.
        kind: the type of what is declared.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something else.
    """
    modules = [importlib.import_module(name) for name in _modules(package)]
    declared = [kind for module in modules for kind in _declared_in(module)]
    declared += [point.load() for point in plug_ins(group)]
    kinds: dict[str, K] = {}
    for one in declared:
        if not isinstance(one, kind):
            raise ConfigurationError(f"{one!r} is not a {kind.__name__}", where=f"entry points {group}")
        if one.name in kinds:
            raise ConfigurationError(f"two kinds are called {one.name!r}", where=f"entry points {group}")
        kinds[one.name] = one
    return kinds


def plug_ins(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of one of our groups, by name; a folder of the path is searched once for all groups."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for place in sys.path:
        for package, points in _packages_in(place or os.getcwd()):
            found.setdefault(package, points)
    ours = [point for points in found.values() for point in points if point.group == group]
    return tuple(sorted(ours, key=lambda point: point.name))


@cache
def _packages_in(place: str) -> tuple[tuple[str, tuple[EntryPoint, ...]], ...]:
    """Return names and entry points of the packages in a folder that have some for us."""
    found: list[tuple[str, tuple[EntryPoint, ...]]] = []
    for package in distributions(path=[place]):
        points = tuple(point for point in package.entry_points if point.group.startswith("orthocapture."))
        if points:
            found.append((package.name, points))
    return tuple(found)


def _modules(package: str) -> list[str]:
    """Return the modules that declare kinds; a folder declares them in its `__init__.py`."""
    path = getattr(importlib.import_module(package), "__path__", None)
    if path is None:
        return [package]
    inside = list(pkgutil.iter_modules(path, f"{package}."))
    folders = [found.name for found in inside if found.ispkg]
    return folders or [found.name for found in inside]


def _declared_in(module: ModuleType) -> list[object]:
    """Return what a module declares as KIND or in KINDS."""
    alone: list[object] = [module.KIND] if hasattr(module, "KIND") else []
    return [*alone, *getattr(module, "KINDS", ())]


class KindsOnDemand(Mapping[str, K]):
    """The kinds that `declared_kinds` finds, each imported when it is asked for: most programs need a few.

    So the module of a kind has its name, or is said to declare it beside others. All are imported when they are
    listed or counted, when an unknown name is asked for, and at once where there are plug-ins: these may not use a
    name twice.
    """

    def __init__(
        self,
        package: str,
        group: str,
        kind: type[K],
        order: Callable[[K], Any],
        shared: Mapping[str, tuple[str, ...]] = _NONE_SHARED,
    ) -> None:
        """Note where kinds are declared.

        Args:
            package: the name of a package, as for `declared_kinds`.
            group: the group of entry points.
            kind: the type of what is declared.
            order: sorts kinds.
            shared: the names of the kinds that a module of the package declares together, in its KINDS.

        Raises:
            ConfigurationError: plug-ins are installed, and `declared_kinds` refuses one.
        """
        self._package, self._group, self._kind, self._order = package, group, kind, order
        self._modules = {name.rpartition(".")[2]: name for name in _modules(package)}
        self._modules |= {name: f"{package}.{module}" for module, names in shared.items() for name in names}
        self._all: dict[str, K] | None = None
        if plug_ins(group):
            self._whole()

    def __getitem__(self, name: str) -> K:
        if self._all is None and name in self._modules:
            for found in _declared_in(importlib.import_module(self._modules[name])):
                if isinstance(found, self._kind) and found.name == name:
                    return found
        return self._whole()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._whole())

    def __len__(self) -> int:
        return len(self._whole())

    def _whole(self) -> dict[str, K]:
        if self._all is None:
            with loading():
                kinds = declared_kinds(self._package, self._group, self._kind)
            self._all = dict(sorted(kinds.items(), key=lambda item: self._order(item[1])))
        return self._all


def kind_named(name: str, known: Mapping[str, K], *, what: str, option: str) -> K:
    """Return the kind of this name.

    Args:
        name: the name that was typed.
        known: the kinds by name.
        what: the noun for such a kind, such as `format`.
        option: the command line's option at which the name was given.

    Raises:
        ConfigurationError: there is none of this name.
    """
    if name not in known:
        raise ConfigurationError(
            f"there is no {what} {name!r}", where=option, remedy=f"Choose one of {', '.join(sorted(known))}"
        )
    return known[name]
