"""All mutations of a file: where something can be changed, and to what.

The changes are those of mutmut (`mutmut.mutation.mutators`: numbers, comparisons, operators, arguments, assignments,
True and False, strings, branches of `match` and of conditional expressions), and four kinds of our own: an operand of
`and` or `or` is left out, a condition is negated, a call or a yield that is a statement of its own is left out, and a
number with a point is ten times larger or smaller. mutmut's own runner leaves out constants of modules and everything
that is decorated, so only its operators are used.

Left out by rule, since no result depends on it:

- annotations, aliases of types, casts, `TYPE_CHECKING`, imports, `__all__`, decorators and their arguments;
- words for people: doc strings, strings with a space in them that are no SQL, what `raise` is followed by, logging,
  arguments called `remedy`, `where`, `description` and `title`;
- `strict=` of `zip`, `len` and `isinstance` (as mutmut does), `__repr__`, `repr=` of fields;
- sizes of pieces in which something is done (names with CHUNK).
"""

from __future__ import annotations

import ast
import difflib
import functools
import hashlib
import itertools
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import libcst as cst
from mutmut.mutation import mutators

from tests.support.mutants.subjects import sources

_TYPES = [
    *("tuple", "list", "dict", "set", "frozenset", "type", "Literal", "Callable", "Mapping", "Sequence", "Iterable"),
    *("Iterator", "Annotated", "NDArray"),
]
_LOGGERS = ["_LOG", "logger", "logging", "warnings"]
_WORDS = ["remedy", "where", "description", "title", "examples", "repr"]
_SQL = re.compile(
    r"[rbuf]*[\"']+\s*(SELECT|INSERT|UPDATE|DELETE|CREATE|DROP|PRAGMA|BEGIN|AND|WHERE)\b", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Place:
    """One possible change: the `index`-th of its file."""

    subject: str
    file: str
    index: int
    kind: str


@dataclass(frozen=True, slots=True)
class Mutation:
    """A change as it stands in the file."""

    place: Place
    line: int
    before: str
    after: str
    text: str  # of the whole file

    @property
    def name(self) -> str:
        """Return where it is."""
        return f"{self.place.file}:{self.line}"


def drawn(tree: Path, seed: str, count: int) -> list[Mutation]:
    """Draw mutations: each subject as often as the others, within it each kind of change, by the seed alone."""
    made = (mutated(tree, place) for place in _in_order(tree, seed))
    return list(itertools.islice((mutation for mutation in made if mutation is not None), count))


def _in_order(tree: Path, seed: str) -> Iterator[Place]:
    ordered: list[list[Place]] = []
    for subject, files in sources(tree).items():
        by_kind: dict[str, list[Place]] = defaultdict(list)
        for file in files:
            for place in places(tree, subject, file):
                by_kind[place.kind].append(place)
        for of_kind in by_kind.values():
            of_kind.sort(key=lambda place: _rank(seed, place.file, place.index))
        ordered.append(
            list(_in_turns(by_kind[kind] for kind in sorted(by_kind, key=lambda k: _rank(seed, subject, k))))
        )
    ordered.sort(key=lambda of_subject: _rank(seed, of_subject[0].subject))
    yield from _in_turns(ordered)


def _rank(*words: object) -> bytes:
    return hashlib.sha256("\n".join(map(str, words)).encode()).digest()


def _in_turns(lists: Iterable[list[Place]]) -> Iterator[Place]:
    rest = [list(reversed(one)) for one in lists]
    while rest := [one for one in rest if one]:
        for one in rest:
            yield one.pop()


def places(tree: Path, subject: str, file: str) -> list[Place]:
    """All places of a file, in order."""
    return [Place(subject, file, index, kind) for index, (kind, _, _) in enumerate(_changes(tree / file)[1])]


def mutated(tree: Path, place: Place) -> Mutation | None:
    """Make the change; None if it changes no more than the spelling, or gives no Python."""
    module, found = _changes(tree / place.file)
    _, node, change = found[place.index]
    old = module.code
    new = cst.ensure_type(module.deep_replace(node, change), cst.Module).code
    try:
        if ast.dump(ast.parse(new)) == ast.dump(ast.parse(old)):
            return None
    except SyntaxError:
        return None
    return Mutation(place, *_difference(old, new), new)


def _difference(old: str, new: str) -> tuple[int, str, str]:
    before, after = old.splitlines(), new.splitlines()
    for tag, i, j, k, end in difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes():
        if tag != "equal":
            return i + 1, " ".join(s.strip() for s in before[i:j]), " ".join(s.strip() for s in after[k:end])
    raise AssertionError("texts with another syntax tree have equal lines")


# --- the operators ---------------------------------------------------------------------------------------


def _in_brackets(node: cst.BaseExpression) -> cst.BaseExpression:
    return node.with_changes(lpar=[cst.LeftParen()], rpar=[cst.RightParen()])


def operator_condition(node: cst.If | cst.CompIf) -> Iterator[cst.CSTNode]:
    """`if a` becomes `if not (a)`."""
    yield node.with_changes(
        test=cst.UnaryOperation(cst.Not(), _in_brackets(node.test)),
        **({} if isinstance(node, cst.If) else {"whitespace_before_test": cst.SimpleWhitespace(" ")}),
    )


def operator_operand(node: cst.BooleanOperation) -> Iterator[cst.CSTNode]:
    """`a and b` becomes `a`, and `b`."""
    for kept in (node.left, node.right):
        yield kept.with_changes(lpar=node.lpar, rpar=node.rpar) if node.lpar else kept


def operator_statement(node: cst.Expr) -> Iterator[cst.CSTNode]:
    """`f(a)` as a statement, and `yield a`, become `pass`."""
    if isinstance(node.value, cst.Call | cst.Yield):
        yield cst.Pass()


def operator_float(node: cst.Float) -> Iterator[cst.CSTNode]:
    """`5.0` becomes `50.0`, and `0.5`."""
    value = float(node.evaluated_value)
    for other in (10.0 * value, 0.1 * value) if value else (1.0,):
        yield node.with_changes(value=repr(other))


def operator_string(node: cst.BaseString) -> Iterator[cst.CSTNode]:
    """The first of mutmut's: `"a"` becomes `"XXaXX"`."""
    yield from list(mutators.operator_string(node))[:1]


OPERATORS: list[tuple[type, Callable[..., Iterable[cst.CSTNode]]]] = [
    *(
        (of, op)
        for of, op in mutators.mutation_operators
        if op not in (mutators.operator_number, mutators.operator_string)
    ),
    (cst.Integer, mutators.operator_number),
    (cst.Float, operator_float),
    (cst.SimpleString, operator_string),
    (cst.If, operator_condition),
    (cst.CompIf, operator_condition),
    (cst.BooleanOperation, operator_operand),
    (cst.Expr, operator_statement),
]


class _Found(NamedTuple):
    kind: str
    node: cst.CSTNode
    change: cst.CSTNode


class _Finder(cst.CSTVisitor):
    """Collects the changes of a file."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[_Found] = []

    def on_visit(self, node: cst.CSTNode) -> bool:
        """Note what a node can be changed to, and go on with its children, unless no result depends on it."""
        if _without_effect(node):
            return False
        for operator in _operators_of(type(node)):
            kind = operator.__name__.removeprefix("operator_")
            self.found.extend(_Found(kind, node, change) for change in operator(node))
        return True


@functools.cache
def _operators_of(kind: type) -> tuple[Callable[..., Iterable[cst.CSTNode]], ...]:
    return tuple(operator for of, operator in OPERATORS if issubclass(kind, of))


@functools.cache
def _changes(path: Path) -> tuple[cst.Module, list[_Found]]:
    module = cst.parse_module(path.read_text(encoding="utf-8"))
    finder = _Finder()
    module.visit(finder)
    return module, finder.found


def _named(node: cst.CSTNode, names: Iterable[str]) -> bool:
    return isinstance(node, cst.Name) and node.value in names


def _without_effect(node: cst.CSTNode) -> bool:  # noqa: PLR0911 - one rule a return
    """Return whether no result depends on a node and what is in it (the rules at the top)."""
    match node:
        case cst.Annotation() | cst.Import() | cst.ImportFrom() | cst.Raise() | cst.Decorator():
            return True
        case cst.SimpleString() | cst.FormattedString() | cst.ConcatenatedString():
            text = _code(node)
            return " " in text and not _SQL.match(text)
        case cst.Subscript(value=value):
            return _named(value, _TYPES)
        case cst.If(test=test):
            return _named(test, ["TYPE_CHECKING"])
        case cst.FunctionDef(name=name):
            return name.value == "__repr__"
        case cst.Arg(keyword=cst.Name(value=word)):
            return word in _WORDS
        case cst.Call(func=cst.Name(value=name), args=args):
            if name == "zip":
                return all(a.keyword is None or a.keyword.value == "strict" for a in args)
            return name in ("len", "isinstance", "cast", "TypeVar", "NewType")
        case cst.Call(func=cst.Attribute(value=value)) | cst.Expr(value=cst.Call(func=cst.Attribute(value=value))):
            return _named(value, _LOGGERS)
        case cst.Assign(targets=[cst.AssignTarget(target=cst.Name(value=name))], value=value):
            return name in ("__all__", "__slots__", *_LOGGERS) or "CHUNK" in name or _is_type(value)
        case _:
            return False


def _is_type(value: cst.BaseExpression) -> bool:
    """Say whether a value is an alias of types: names with a capital, `None`, subscripts of types, joined by `|`."""
    match value:
        case cst.BinaryOperation(left=left, operator=cst.BitOr(), right=right):
            return _is_type(left) and _is_type(right)
        case cst.Subscript(value=inner):
            return _named(inner, _TYPES)
        case cst.Name(value=name):
            return name[:1].isupper() and not name.isupper()
        case _:
            return False


def _code(node: cst.CSTNode) -> str:
    return cst.Module([]).code_for_node(node)
