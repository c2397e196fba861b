"""The declaration of a method of reconstruction, and the methods that there are."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from service.core.declared_kinds import declared_kinds, kind_named
from service.core.geometry import Array

GROUP = "orthocapture.reconstruction_methods"
Command = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Workplace:
    """Where a method works.

    Attributes:
        data: folder with the exported data set, which the method reads.
        work: folder for what it writes.
        checkout: folder of the method's source code; empty if it is found on the path.
        python: interpreter with the packages that the method needs.
    """

    data: Path
    work: Path
    checkout: Path = field(default_factory=Path)
    python: str = "python"


@dataclass(frozen=True, slots=True)
class Method:
    """A method of reconstruction.

    Attributes:
        name: as it is named on the command line.
        words: what it is called in the table.
        expects: program and version that the commands are written for, and what it needs.
        form: name of the export format that it reads.
        commands: what is run, one after the other; a pure function of the place.
        mesh: finds the mesh that the commands left. Raises DataError if there is none.
        to_world: transforms vertices (V, 3) of that mesh to the world frame, m; it may read the exported folder. Most
            methods' meshes are in the world frame already.
        programs: looked for on the path.
        variable: of the environment, with the folder of its source code; "" if it needs none.
        lacking: says what else is missing to run it on this machine; "" if nothing is.
    """

    name: str
    words: str
    expects: str
    form: str
    commands: Callable[[Workplace], tuple[Command, ...]]
    mesh: Callable[[Workplace], Path]
    to_world: Callable[[Array, Path], Array] = lambda vertices, _data: vertices
    programs: tuple[str, ...] = ()
    variable: str = ""
    lacking: Callable[[], str] = lambda: ""


def methods() -> dict[str, Method]:
    """Every method by its name.

    Raises:
        ConfigurationError: two have the same name, or an entry point names something else.
    """
    return declared_kinds("service.benchmark.methods", GROUP, Method)


def method_named(name: str) -> Method:
    """The method of this name.

    Raises:
        ConfigurationError: there is none.
    """
    return kind_named(name, methods(), what="method", option="--method")


def missing(method: Method, environment: Mapping[str, str] = os.environ) -> str:
    """What is missing to run a method here, in words; "" if it can be run."""
    lacks = [program for program in method.programs if shutil.which(program, path=environment.get("PATH")) is None]
    if lacks:
        return f"{', '.join(lacks)} not found on the path"
    if method.variable and not environment.get(method.variable):
        return f"{method.variable} is not set"
    if method.variable and not Path(environment[method.variable]).is_dir():
        return f"{method.variable} names no folder"
    return method.lacking()


def place_of(method: Method, folder: Path, environment: Mapping[str, str] = os.environ) -> Workplace:
    """Where a method works below a folder: `data` and `work`, with its checkout and interpreter.

    `VARIABLE_PYTHON` names the interpreter of a checkout with an environment of its own, `python` is the default;
    methods without a checkout run in this program's.
    """
    folder = folder.resolve()
    data, work = folder / "data", folder / "work"
    if not method.variable:
        return Workplace(data, work, python=sys.executable)
    python = environment.get(f"{method.variable}_PYTHON", "python")
    return Workplace(data, work, Path(environment.get(method.variable, f"${method.variable}")), python)
