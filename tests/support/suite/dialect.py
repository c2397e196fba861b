"""Finds turns of phrase that a newcomer stumbles over; `python -m bench.suite.dialect` counts them."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[3]
FOLDERS = ("service", "drivers", "simulators", "bench", "tests", "docs")

#: Words with which a docstring, or an argument's line in it, begins that is no sentence and says not what it is.
PREPOSITIONS = re.compile(
    r"about|above|across|after|against|along|among|around|as|at|before|behind|below|beneath|beside|between|beyond|by|"
    r"down|during|for|from|in|inside|into|like|near|of|off|on|onto|out|outside|over|since|through|to|toward|towards|"
    r"under|until|up|upon|via|what|where|whether|which|who|whose|with|within|without"
)
#: Names of functions that are neither a verb nor the noun that they return.
PARTICIPLES = re.compile(
    r"_*(told|added|judged|again|anew|stated|kept|said|shown|found|read_in|asked|given|taken|left|made|seen|done|known|"
    r"moved|closed|opened|counted|joined|placed|checked|drawn|sorted_out|cut|put|tried|waited|answered|measured)"
)
#: Words of this house for which the field has others: label or text, format, stored, report.
HOUSE_WORDS = re.compile(r"words|forms?|kept|tells?|told")
_HOUSE_TEXT = re.compile(r"\b(?:kept|tells?|told|anew|lacks)\b", re.IGNORECASE)
_ARGUMENT = re.compile(r"^    \w+: (.+)$", re.MULTILINE)
Nodes = Iterable[ast.AST]
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True, slots=True)
class Place:
    """A line of a file, and what stands there."""

    path: str
    line: int
    text: str


def docstrings_of(nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield the docstrings of functions and classes, and each argument's line in them, with the line of the name."""
    for node in nodes:
        if isinstance(node, (*_FUNCTIONS, ast.ClassDef)) and (text := ast.get_docstring(node)):
            yield node.lineno, text
            yield from ((node.lineno, line) for line in _ARGUMENT.findall(text))


def first_word(text: str) -> str:
    """Return the first word of a text in small letters, "" if there is none."""
    found = re.match(r"\W*(\w+)", text)
    return found.group(1).lower() if found else ""


def _prepositions(nodes: Nodes, _text: str) -> Iterator[tuple[int, str]]:
    yield from ((line, text) for line, text in docstrings_of(nodes) if PREPOSITIONS.fullmatch(first_word(text)))


def _participles(nodes: Nodes, _text: str) -> Iterator[tuple[int, str]]:
    for node in nodes:
        if isinstance(node, _FUNCTIONS) and PARTICIPLES.fullmatch(node.name):
            yield node.lineno, node.name


def _for_one_in(_nodes: Nodes, text: str) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(text.splitlines(), start=1):
        yield from ((number, line.strip()) for _ in re.findall(r"\bfor one in\b", line))


def _house_names(nodes: Nodes, _text: str) -> Iterator[tuple[int, str]]:
    for node in nodes:
        if isinstance(node, (*_FUNCTIONS, ast.ClassDef)):
            name, line = node.name, node.lineno
        elif isinstance(node, ast.arg):
            name, line = node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name, line = node.id, node.lineno
        else:
            continue
        if any(HOUSE_WORDS.fullmatch(part.lower()) for part in name.split("_")):
            yield line, name


def _house_text(nodes: Nodes, _text: str) -> Iterator[tuple[int, str]]:
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            lines = node.value.splitlines()
            yield from (
                (node.lineno + offset, line.strip())
                for offset, line in enumerate(lines)
                for _ in _HOUSE_TEXT.findall(line)
            )


TICS: Mapping[str, Callable[[Nodes, str], Iterator[tuple[int, str]]]] = {
    "preposition": _prepositions,  # docstrings and arguments' lines that begin with one
    "participle": _participles,  # functions that are named by a participle or an adverb
    "for-one-in": _for_one_in,
    "house-name": _house_names,  # names with words, form, kept, tell or told in them
    "house-text": _house_text,  # docstrings and messages with kept, tell, told, anew or lacks
}


def places_in(folders: Iterable[str], root: Path = REPOSITORY) -> dict[str, list[Place]]:
    """Return where each turn of phrase stands in the Python files of these top-level folders."""
    found: dict[str, list[Place]] = {tic: [] for tic in TICS}
    for path in (path for folder in folders for path in sorted((root / folder).rglob("*.py"))):
        if path == Path(__file__):  # it names them all
            continue
        text = path.read_text(encoding="utf-8")
        nodes, name = list(ast.walk(ast.parse(text))), path.relative_to(root).as_posix()
        for tic, places in TICS.items():
            found[tic] += [Place(name, line, phrase) for line, phrase in places(nodes, text)]
    return found
