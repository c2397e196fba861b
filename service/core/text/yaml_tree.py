"""YAML text as plain data, with the line number of every field."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import yaml
from yaml.composer import Composer
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.parser import Parser

from service.core.errors import ProtocolError

FieldPath = tuple[str | int, ...]  # ("steps", 3, "gates", 0, "max")
Plain = None | bool | int | float | str | list["Plain"] | dict[str, "Plain"]

MOST_DEEP = 50
MOST_VALUES = 200_000
_LONGEST_INTEGER = 18  # characters; a longer integer is read as a float
# Text that libyaml and PyYAML itself read alike: no tabs, directives, byte order marks or unusual ends of lines,
# no tags, no "?", which begins a key or is part of a word, and no comment that touches the sign of a block.
_READ_ALIKE = re.compile(
    r"(?!%)(?:[ \"-=@-{}~\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]++"
    r"|[|>](?![-+0-9]*#)|\n(?!%))*+"
)

# The core schema of YAML 1.2 (section 10.3). Unlike in YAML 1.1, "on" and "12:30" are text and 1e-3 is a number.
_SCALARS: tuple[tuple[re.Pattern[str], Callable[[str], Plain]], ...] = (
    (re.compile(r"(null|Null|NULL|~|)"), lambda _: None),
    (re.compile(r"(true|True|TRUE|false|False|FALSE)"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]+"), lambda text: int(text) if len(text) <= _LONGEST_INTEGER else float(text)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
)


@dataclass(frozen=True)
class YamlProblem:
    """One thing that is wrong in a file."""

    line: int  # from 1
    field: str  # such as steps[3].gates[0].max; "" for the file as a whole
    message: str


@dataclass(frozen=True)
class YamlTree:
    """A YAML document: its data, the line of every field, and problems such as duplicate keys."""

    data: Plain
    lines: Mapping[FieldPath, int]
    problems: tuple[YamlProblem, ...]

    def line(self, path: FieldPath) -> int:
        """The line of a field, or of the nearest enclosing field that is in the file."""
        while path not in self.lines:
            path = path[:-1]
        return self.lines[path]


NO_LINES = YamlTree(data={}, lines={(): 0}, problems=())  # for data that is not from a YAML file


def field_name(path: FieldPath) -> str:
    """`steps[3].gates[0].max` for ("steps", 3, "gates", 0, "max")."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")


def parse_yaml(text: str, *, name: str) -> YamlTree:
    """Read one YAML document.

    Raises ProtocolError with `name`:line if the text is not YAML, is nested more than 50 deep, or has more than
    200,000 values with all aliases expanded.
    """
    try:
        root = _composed(text, name)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise ProtocolError(
            f"not valid YAML: {error.problem or error.context}",
            where=f"{name}:{line}",
            remedy="Look for a missing colon, wrong indentation or a tab on this line or the one above it",
        ) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ProtocolError(
            f"not valid YAML: {error.reason}", where=f"{name}:{line}", remedy="Remove the unprintable character"
        ) from error
    except (ValueError, OverflowError, RecursionError) as error:  # raised for an escape that is not a character
        raise ProtocolError(
            f"not valid YAML: {error}",
            where=f"{name}:1",
            remedy="Look for an escape such as \\U… that is not a character",
        ) from error
    builder = _Builder(name)
    data = None if root is None else builder.build(root, (), ())
    return YamlTree(data=data, lines=builder.lines, problems=tuple(builder.problems))


def _composed(text: str, name: str) -> Node | None:
    """The tree of the text, by libyaml where PyYAML has it and the text is one that both read alike.

    PyYAML's own parser has the last word on what is wrong, and in which line.
    """
    if _library_loader is not None and _READ_ALIKE.fullmatch(text):
        try:
            return _library_loader(text, name).get_single_node()
        except (yaml.YAMLError, ProtocolError, ValueError):
            pass
    loader = _Loader(text, name)
    try:
        return loader.get_single_node()
    finally:
        loader.dispose()


class _ShallowComposer(Composer):
    """Refuses deep nesting while it composes the tree, which is recursive and would end in a RecursionError."""

    _file: str
    _depth = 0

    def compose_sequence_node(self, anchor: Any) -> SequenceNode:
        with self._one_deeper():
            return super().compose_sequence_node(anchor)

    def compose_mapping_node(self, anchor: Any) -> MappingNode:
        with self._one_deeper():
            return super().compose_mapping_node(anchor)

    def descend_resolver(self, current_node: Any, current_index: Any) -> None:
        """Nothing: tags have no meaning here."""

    def ascend_resolver(self) -> None:
        """Nothing, likewise."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:
        """No tag."""
        return ""

    @contextmanager
    def _one_deeper(self) -> Generator[None]:
        self._depth += 1
        if self._depth > MOST_DEEP:
            start = cast("Parser", self).peek_event().start_mark
            raise ProtocolError(
                f"nested more than {MOST_DEEP} deep",
                where=f"{self._file}:{start.line + 1 if start else 1}",
                remedy="Look for brackets that are not closed",
            )
        yield
        self._depth -= 1


class _Loader(_ShallowComposer, yaml.SafeLoader):
    """Scans and parses in Python."""

    def __init__(self, text: str, name: str) -> None:
        super().__init__(text)
        self._file = name


_library_loader: Callable[[str, str], Composer] | None = None
if yaml.__with_libyaml__:

    class _LibraryLoader(_ShallowComposer, yaml.CBaseLoader):
        """Scans and parses in C, ten times as fast."""

        def __init__(self, text: str, name: str) -> None:
            yaml.CBaseLoader.__init__(self, text)
            Composer.__init__(self)
            self._file = name

    _library_loader = _LibraryLoader


class _Builder:
    """Walks the composed tree once; an alias is expanded wherever it occurs."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._values = 0
        self.lines: dict[FieldPath, int] = {(): 1}
        self.problems: list[YamlProblem] = []

    def build(self, node: Node, path: FieldPath, around: tuple[Node, ...]) -> Plain:
        if any(node is outer for outer in around):
            self._problem(node, path, "an alias that contains itself")
            return None
        self._values += 1
        if self._values > MOST_VALUES:
            raise ProtocolError(
                f"more than {MOST_VALUES:,} values with all aliases expanded",
                where=f"{self._name}:{node.start_mark.line + 1}",
                remedy="Write the file without aliases of aliases",
            )
        around = (*around, node)
        if isinstance(node, MappingNode):
            return self._mapping(node, path, around)
        if isinstance(node, SequenceNode):
            items: list[Plain] = []
            for index, item in enumerate(node.value):
                self.lines[(*path, index)] = item.start_mark.line + 1
                items.append(self.build(item, (*path, index), around))
            return items
        assert isinstance(node, ScalarNode)
        return _scalar(node)

    def _mapping(self, node: MappingNode, path: FieldPath, around: tuple[Node, ...]) -> dict[str, Plain]:
        data: dict[str, Plain] = {}
        for key, value in node.value:
            name = _scalar(key) if isinstance(key, ScalarNode) else None
            if not isinstance(name, str):
                self._problem(key, path, f"the key {key.value!r} is not text")
            elif name in data:
                first = self.lines[(*path, name)]
                self._problem(key, (*path, name), f"duplicate key, first given on line {first}")
            else:
                self.lines[(*path, name)] = key.start_mark.line + 1
                data[name] = self.build(value, (*path, name), around)
        return data

    def _problem(self, node: Node, path: FieldPath, message: str) -> None:
        self.problems.append(YamlProblem(node.start_mark.line + 1, field_name(path), message))


def _scalar(node: ScalarNode) -> Plain:
    text: str = node.value
    if not node.style:  # plain: not quoted, not a block
        for pattern, convert in _SCALARS:
            if pattern.fullmatch(text):
                return convert(text)
    return text
