"""Check a YAML file against a pydantic model and report every problem at once, each with its line."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NoReturn, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from service.core.errors import OrthocaptureError
from service.core.text.yaml_tree import FieldPath, Plain, YamlProblem, YamlTree, field_name

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
    """Part of a file as an instance of `model`, or None and what is wrong with it.

    Types are strict, as in JSON: quoted text is not a number, and `yes` is not a boolean.

    Args:
        data: the data at `at` in the file.
        model: the pydantic model of that part.
        tree: the file, for line numbers.
        at: path to the part within the file.
    """
    try:
        return model.model_validate_json(json.dumps(data), strict=True), []
    except ValidationError as error:
        return None, [problem_of(details, tree, model, at) for details in error.errors()]


def problem_of(details: ErrorDetails, tree: YamlTree, model: type[BaseModel], at: FieldPath = ()) -> YamlProblem:
    """A pydantic error in plain words, with its line; the instance of `model` begins at path `at`."""
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
    """` (did you mean 'title'?)` if a known word is similar, else ""."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def refuse(
    problems: Iterable[YamlProblem], *, what: str, name: str, remedy: str, error: type[OrthocaptureError]
) -> NoReturn:
    """Raise `error` listing every problem in the order of its line.

    Args:
        problems: at least one.
        what: the kind of file, such as "protocol".
        name: the file's name.
        remedy: what the reader should do.
        error: the class to raise.
    """
    ordered = sorted(set(problems), key=lambda p: (p.line, p.field))
    places = [(f"{name}:{p.line}" if p.line else name) + (f" {p.field}" if p.field else "") for p in ordered]
    if len(ordered) == 1:
        raise error(ordered[0].message, where=places[0], remedy=remedy)
    listed = "\n".join(f"  {place}: {p.message}" for place, p in zip(places, ordered, strict=True))
    raise error(f"{len(ordered)} things are wrong in this {what}:\n{listed}\n", where=name, remedy=remedy)


def _known(model: type[BaseModel], path: FieldPath) -> Mapping[str, object]:
    """The fields of the model at `path` within `model`, for suggestions."""
    models = [model]
    for part in path:
        fields = [each.model_fields[part] for each in models if isinstance(part, str) and part in each.model_fields]
        models = [inside for field in fields for inside in _records(field.annotation)] or models
    return {name: field for each in models for name, field in each.model_fields.items()}


def _records(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models named in a field's type, also within tuples, mappings and unions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inside in get_args(annotation):
        yield from _records(inside)
