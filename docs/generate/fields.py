"""The fields of a record as a table: key, type, default, unit, meaning, from the types and comments of the code."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterator, Mapping
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from service.core.step_params import NamesStep

# The end of a name → the unit of its number; the longest that fits counts.
UNITS: Mapping[str, str] = {
    "acceleration_rad_s2": "rad/s²", "rad_s2": "rad/s²", "rad_s": "rad/s", "m_s": "m/s", "monotonic_s": "s",
    "mm": "mm", "m": "m", "um": "µm", "s": "s", "min": "min", "px": "px", "deg": "°", "mrad": "mrad", "rad": "rad",
    "kg": "kg", "hu": "HU", "lux": "lx", "c": "°C", "bytes": "bytes", "aperture_f": "f-number", "iso": "ISO",
    "utc": "ISO 8601", "sha256": "hex",
}  # fmt: skip
_PLAIN = {float: "number", int: "whole number", str: "text", bool: "yes or no", Any: "anything", object: "anything"}
_BOUNDS = (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))
_ATTRIBUTES = re.compile(r"\n\nAttributes:\n")
_HEAD = ("| key | type | default | unit | meaning |", "|---|---|---|---|---|")


def field_table(model: type[Any], *, without: tuple[str, ...] = ()) -> list[str]:
    """Lines of a Markdown table; `without` names fields that are left out."""
    comments = field_comments(model)
    rows = [
        f"| `{name}` | {_type_of(field)} | {_default(field)} | {_unit(name, field)} | {comments.get(name, '')} |"
        for name, field in _fields_of(model).items()
        if name not in without
    ]
    return [*_HEAD, *rows] if rows else ["No keys."]


def docstring(model: Any) -> str:
    """The docstring without its attributes, which stand in the table; "" where it has none of its own."""
    return _ATTRIBUTES.split(inspect.cleandoc(model.__doc__))[0] if model.__doc__ else ""


def record_sections(below: Mapping[str, type[Any]], level: str = "###") -> list[str]:
    """Lines with a heading, the docstring and the table of each record that `records_below` found."""
    lines: list[str] = []
    for name, model in below.items():
        lines += [f"{level} {name}", "", docstring(model), "", *field_table(model), ""]
    return lines


def unit_of(name: str) -> str:
    """The unit that a name ends in; "" for none."""
    fitting = [end for end in UNITS if name.endswith(f"_{end}") or name == end == "iso"]
    return UNITS[max(fitting, key=len)] if fitting else ""


def records_below(
    model: type[Any], seen: dict[str, type[Any]] | None = None, *, without: tuple[str, ...] = ()
) -> dict[str, type[Any]]:
    """The records that its fields are made of, at any depth, by name, in the order of the fields."""
    found = {} if seen is None else seen
    for field in (field for name, field in _fields_of(model).items() if name not in without):
        for inner in _records_in(field.annotation):
            if inner.__name__ not in found:
                found[inner.__name__] = inner
                records_below(inner, found)
    return found


def field_comments(model: type[Any]) -> dict[str, str]:
    """Return what the code says of each field: among the docstring's attributes, or beside or right above it."""
    out: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if _is_record(base) and base is not BaseModel:
            out |= _attributes_of(base)
            out |= _comments_in(textwrap.dedent(inspect.getsource(base)))
    for name, field in _fields_of(model).items():
        if field.description:
            out[name] = field.description
    said = {name: re.sub(r"\bNone: ", "without it: ", text) for name, text in out.items()}
    return {name: text.replace("|", "\\|") for name, text in said.items()}


def _is_record(annotation: Any) -> bool:
    """Return whether a type is a record whose fields are listed: a model or a dataclass."""
    is_class = isinstance(annotation, type)
    return is_class and (issubclass(annotation, BaseModel) or dataclasses.is_dataclass(annotation))


def _fields_of(model: type[Any]) -> dict[str, FieldInfo]:
    if issubclass(model, BaseModel):
        return model.model_fields
    types = get_type_hints(model, include_extras=True)
    return {
        field.name: FieldInfo.from_annotation(types[field.name])
        if field.default is dataclasses.MISSING
        else FieldInfo.from_annotated_attribute(types[field.name], field.default)
        for field in dataclasses.fields(model)
    }


def _attributes_of(model: type[Any]) -> dict[str, str]:
    _, *attributes = _ATTRIBUTES.split(inspect.cleandoc(model.__doc__ or ""))
    lines = re.split(r"\n(?! {5})", "".join(attributes))  # what is indented further goes on with the line before
    pairs = (line.strip().partition(": ") for line in lines)
    return {name: re.sub(r"\s+", " ", text) for name, found, text in pairs if found}


def _comments_in(source: str) -> dict[str, str]:
    said: dict[int, tuple[str, bool]] = {}  # line → comment, whether it has the line for itself
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            alone = token.line.lstrip().startswith("#")
            said[token.start[0]] = (token.string.lstrip("# ").strip(), alone)
    out: dict[str, str] = {}
    (definition,) = ast.parse(source).body
    for node in definition.body if isinstance(definition, ast.ClassDef) else ():
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        above: list[str] = []
        line = node.lineno - 1
        while line in said and said[line][1]:
            above.insert(0, said[line][0])
            line -= 1
        beside = [said[n][0] for n in range(node.lineno, (node.end_lineno or node.lineno) + 1) if n in said]
        text = " ".join([*above, *beside])
        if text and not re.match(r"(noqa|fmt|type):", text):
            out[node.target.id] = text
    return out


def _records_in(annotation: Any) -> Iterator[type[Any]]:
    if _is_record(annotation):
        yield annotation
    for inner in get_args(annotation):
        yield from _records_in(inner)


def _type_of(field: FieldInfo) -> str:
    said = _words(field.annotation, tuple(field.metadata))
    named = [one for one in field.metadata if isinstance(one, NamesStep)]
    return f"{said}: an earlier step that {named[0].does}" if named else said


def _words(annotation: Any, metadata: tuple[Any, ...] = ()) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    bounds = _bounds(metadata)
    if hasattr(annotation, "__metadata__"):  # Annotated
        said = _words(inner[0], annotation.__metadata__)
    elif origin is Literal:
        said = " or ".join(f"`{value}`" for value in inner)
    elif origin in (Union, UnionType):
        said = " or ".join(_words(one, metadata) for one in inner if one is not NoneType)
    elif origin in (tuple, list):
        said = _many(inner, bounds)
    elif origin is not None and issubclass(origin, Mapping):
        said = f"mapping of {_words(inner[0])} to {_words(inner[1])}"
    elif _is_record(annotation):
        said = f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    else:
        said = f"{_PLAIN.get(annotation, getattr(annotation, '__name__', str(annotation)))}{bounds}"
    return said


def _many(inner: tuple[Any, ...], bounds: str) -> str:
    if Ellipsis in inner or len(inner) == 1:
        return f"list of {_words(inner[0])}{bounds}"
    if not inner:
        return "empty list"
    return f"{len(inner)} × {_words(inner[0])}" if len(set(inner)) == 1 else ", ".join(map(_words, inner))


def _bounds(metadata: tuple[Any, ...]) -> str:
    """Limits of a number or a length, as annotated-types or pydantic hold them."""
    flat: list[Any] = []
    for one in metadata:
        flat += one.metadata if isinstance(one, FieldInfo) else [one]
    said = [f"{sign} {getattr(one, name):g}" for one in flat for name, sign in _BOUNDS if _has(one, name)]
    said += [f"at least {one.min_length}" for one in flat if _has(one, "min_length") and one.min_length > 1]
    patterns = [one.pattern for one in flat if _has(one, "pattern")]
    text = f" {' and '.join(said)}" if said else ""
    shown = [pattern.replace("|", "\\|") for pattern in patterns]
    return text + "".join(f" like `{pattern}`" for pattern in shown)


def _has(one: Any, name: str) -> bool:
    return getattr(one, name, None) is not None


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default_factory() if field.default_factory is not None else field.default  # type: ignore[call-arg]
    if value is PydanticUndefined:
        return "required"
    return _value(value)


def _value(value: Any) -> str:
    if value is None or value == "" or value in ((), {}, []):
        return "none"
    if isinstance(value, BaseModel):
        return "as there"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple) and any(isinstance(one, BaseModel | tuple) or len(str(one)) > 20 for one in value):
        return f"{len(value)} of them"
    shown = (
        ", ".join(map(str, value))
        if isinstance(value, tuple)
        else f"{value:g}"
        if isinstance(value, float)
        else value
    )
    return f"`{shown}`"


def _unit(name: str, field: FieldInfo) -> str:
    return unit_of(name) if re.search(r"float|int|str", str(field.annotation)) else ""
