"""Kinds that are declared once, as KIND in a module of their own: those of a package, and those of plug-ins."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Protocol, TypeVar

from service.core.errors import ConfigurationError


class DeclaredKind(Protocol):
    """What every kind has."""

    @property
    def name(self) -> str:
        """In protocols and records."""
        ...


K = TypeVar("K", bound=DeclaredKind)


def declared_kinds(package: str, group: str, kind: type[K]) -> dict[str, K]:
    """The kinds of this type by name: of every module below `package` that defines KIND, and of entry points.

    Args:
        package: name of the package, at any depth of which modules are looked for.
        group: of the entry points, each of which names a kind.
        kind: the type of what is declared.

    Raises:
        ConfigurationError: two declare the same name, or an entry point names something else.
    """
    path = importlib.import_module(package).__path__
    names = [found.name for found in pkgutil.walk_packages(path, f"{package}.") if not found.ispkg]
    modules = [importlib.import_module(name) for name in names]
    declared: list[object] = [module.KIND for module in modules if hasattr(module, "KIND")]
    declared += [point.load() for point in entry_points(group=group)]
    kinds: dict[str, K] = {}
    for one in declared:
        if not isinstance(one, kind):
            raise ConfigurationError(f"{one!r} is not a {kind.__name__}", where=f"entry points {group}")
        if one.name in kinds:
            raise ConfigurationError(f"two kinds are called {one.name!r}", where=f"entry points {group}")
        kinds[one.name] = one
    return kinds


def kind_named(name: str, known: Mapping[str, K], *, what: str, option: str) -> K:
    """The kind of this name.

    Args:
        name: as it was typed.
        known: the kinds by name.
        what: a kind in words, such as `format`.
        option: of the command line, at which the name was given.

    Raises:
        ConfigurationError: there is none of this name.
    """
    if name not in known:
        raise ConfigurationError(
            f"there is no {what} {name!r}", where=option, remedy=f"Choose one of {', '.join(sorted(known))}"
        )
    return known[name]
