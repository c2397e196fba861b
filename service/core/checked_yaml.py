"""Reads YAML with the line of every field, and checks it against a model: all problems at once, with their lines."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar, cast, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from yaml.composer import Composer
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.parser import Parser

from service.core.errors import OrthocaptureError, ProtocolError

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
        """Return the line of a field, or of the nearest enclosing field that is in the file."""
        while path not in self.lines:
            path = path[:-1]
        return self.lines[path]


NO_LINES = YamlTree(data={}, lines={(): 0}, problems=())  # for data that is not from a YAML file


def field_name(path: FieldPath) -> str:
    """Return `steps[3].gates[0].max` for ("steps", 3, "gates", 0, "max")."""
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
    """Return the tree of the text, by libyaml where PyYAML has it and the text is one that both read alike.

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
        """Do nothing: tags have no meaning here."""

    def ascend_resolver(self) -> None:
        """Do nothing, likewise."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:
        """Return no tag."""
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


ModelT = TypeVar("ModelT", bound=BaseModel)


def decoded(content: bytes, *, name: str, error: type[OrthocaptureError]) -> str:
    """Decode UTF-8 with or without a byte order mark. Raises `error` with the line of the first invalid byte."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as why:
        line = content.count(b"\n", 0, why.start) + 1
        raise error("not UTF-8 text", where=f"{name}:{line}", remedy="Save the file as UTF-8") from why


def checked(
    data: Plain, model: type[ModelT], tree: YamlTree, at: FieldPath = ()
) -> tuple[ModelT | None, list[YamlProblem]]:
    """Read part of a file as an instance of `model`; return it, or None, and what is wrong with it.

    Types are strict, as in JSON: quoted text is not a number, and `yes` is not a boolean.

    Args:
        data: the data at `at` in the file.
        model: the pydantic model of that part.
        tree: the file, for line numbers.
        at: the path to the part within the file.
    """
    try:
        return model.model_validate_json(json.dumps(data), strict=True), []
    except ValidationError as error:
        return None, [problem_of(details, tree, model, at) for details in error.errors()]


def problem_of(details: ErrorDetails, tree: YamlTree, model: type[BaseModel], at: FieldPath = ()) -> YamlProblem:
    """Return a pydantic error in plain English, with its line; the instance of `model` begins at path `at`."""
    start = len(at)
    for part in details["loc"]:
        if (*at, part) in tree.lines:  # pydantic also puts names of union members into the path
            at = (*at, part)
    kind, last = details["type"], details["loc"][-1] if details["loc"] else ""
    if kind == "missing":
        return YamlProblem(tree.line(at), field_name((*at, last)), "missing field")
    if kind == "extra_forbidden":
        near = did_you_mean(str(last), _known(model, at[start:-1]))
        return YamlProblem(tree.line(at), field_name(at), f"unknown field{near}")
    message = details["msg"].removeprefix("Value error, ")
    given = details["input"]
    shown = "" if isinstance(given, (dict, list)) else f" (it is {json.dumps(given, default=str)})"
    quote = '; put it in quotes: "…"' if kind == "string_type" and isinstance(given, (int, float)) else ""
    return YamlProblem(tree.line(at), field_name(at), f"{message}{shown}{quote}")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ` (did you mean 'title'?)` if a known word is similar, else ""."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def refuse(
    problems: Iterable[YamlProblem], *, what: str, name: str, remedy: str, error: type[OrthocaptureError]
) -> NoReturn:
    """Raise `error` listing every problem in the order of its line.

    Args:
        problems: the problems, one or more.
        what: the kind of file, such as "protocol".
        name: the file's name.
        remedy: the advice to the reader.
        error: the class to raise.
    """
    ordered = sorted(set(problems), key=lambda p: (p.line, p.field))
    places = [(f"{name}:{p.line}" if p.line else name) + (f" {p.field}" if p.field else "") for p in ordered]
    if len(ordered) == 1:
        raise error(ordered[0].message, where=places[0], remedy=remedy)
    listed = "\n".join(f"  {place}: {p.message}" for place, p in zip(places, ordered, strict=True))
    raise error(f"{len(ordered)} things are wrong in this {what}:\n{listed}\n", where=name, remedy=remedy)


def _known(model: type[BaseModel], path: FieldPath) -> Mapping[str, object]:
    """Return the fields of the model at `path` within `model`, for suggestions."""
    models = [model]
    for part in path:
        fields = [each.model_fields[part] for each in models if isinstance(part, str) and part in each.model_fields]
        models = [inside for field in fields for inside in _records(field.annotation)] or models
    return {name: field for each in models for name, field in each.model_fields.items()}


def _records(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models named in a field's type, also within tuples, mappings and unions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inside in get_args(annotation):
        yield from _records(inside)
