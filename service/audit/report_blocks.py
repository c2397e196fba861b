"""The content of a report as plain records, which are written as HTML or as PDF, and its numbers as text."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import ClassVar, Literal

from service.computations import term
from service.core.gates import Standing, figure, limits, standing
from service.core.measure_names import measure_name
from service.core.records.run_events import GateVerdict

Tone = Literal["plain", "ok", "attention", "stop"]
Style = Literal["text", "number", "code"]


@dataclass(frozen=True, slots=True)
class TableCell:
    """A text and its tone."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: `share` of the width, relative to the others."""

    heading: str
    share: float = 1.0
    style: Style = "text"


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Running text; with a tone other than plain, a highlighted statement."""

    kind: ClassVar[str] = "paragraph"
    text: str
    tone: Tone = "plain"


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading within a section."""

    kind: ClassVar[str] = "heading"
    text: str


@dataclass(frozen=True, slots=True)
class DescriptionList:
    """A list of names and values."""

    kind: ClassVar[str] = "description list"
    rows: tuple[tuple[str, TableCell | str], ...]


@dataclass(frozen=True, slots=True)
class Table:
    """Rows. `strong`: indices of highlighted rows; `spanning`: of rows whose first text spans every column."""

    kind: ClassVar[str] = "table"
    columns: tuple[Column, ...]
    rows: tuple[tuple[TableCell | str, ...], ...]
    strong: frozenset[int] = frozenset()
    spanning: frozenset[int] = frozenset()
    small: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A small copy of a photograph with its caption; `jpeg` is None if the file is missing or altered.

    `sha256` is the name of the original in the evidence.
    """

    caption: str
    jpeg: bytes | None
    width: int = 0
    height: int = 0
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class Pictures:
    """Photographs in a number of columns."""

    kind: ClassVar[str] = "pictures"
    items: tuple[Picture, ...]
    columns: int


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A filled rectangle of a drawing; y grows downwards."""

    x: float
    y: float
    width: float
    height: float
    colour: str


@dataclass(frozen=True, slots=True)
class Line:
    """A straight line of a drawing."""

    x1: float
    y1: float
    x2: float
    y2: float
    colour: str
    width: float = 1.0


@dataclass(frozen=True, slots=True)
class Label:
    """A text in a drawing; x, y: position of its baseline at the anchor."""

    x: float
    y: float
    text: str
    size: float = 9.0
    colour: str = "#1a1f24"
    anchor: Literal["start", "middle", "end"] = "middle"


@dataclass(frozen=True, slots=True)
class Raster:
    """A picture within a drawing, as PNG."""

    x: float
    y: float
    width: float
    height: float
    png: bytes = field(repr=False)


Shape = Rectangle | Line | Label | Raster


@dataclass(frozen=True, slots=True)
class Drawing:
    """A chart in its own units, scaled to the available width; `text` describes it.

    `name`: of its file, without suffix; `rows`: the figures that it shows, below a row of their names with units.
    """

    title: str
    text: str
    width: float
    height: float
    shapes: tuple[Shape, ...]
    name: str = ""
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class Drawings:
    """Charts, two in a row."""

    kind: ClassVar[str] = "drawings"
    items: tuple[Drawing, ...]


@dataclass(frozen=True, slots=True)
class SceneBlock:
    """The 3D scene: a drawing of the initial view, and an HTML element that can be turned, or ""."""

    kind: ClassVar[str] = "scene"
    drawing: Drawing
    html: str = field(repr=False)


# The kind of a block names it in the template of the HTML report; without one, the report is not made.
Block = Paragraph | Heading | DescriptionList | Table | Pictures | Drawings | SceneBlock


@dataclass(frozen=True, slots=True)
class Section:
    """A numbered section of the report."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """A whole report; the first six fields are what a reader must not miss, on the first page."""

    title: str
    simulated: bool
    origin: TableCell | None  # None: the run took its photographs itself
    release: TableCell | None  # None: the protocol does not ask for one
    verification: TableCell
    result: TableCell
    deviations: TableCell
    facts: DescriptionList
    sections: tuple[Section, ...]
    run_id: str
    head_sha256: str
    made_at: datetime  # UTC, to the second


def utc(text: str) -> str:
    """Return a time in ISO 8601 as `2026-11-21 10:12:03 UTC`."""
    moment = datetime.fromisoformat(text)
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"


def moment(at: datetime) -> str:
    """Return a datetime as `2026-11-21 10:12:03 UTC`."""
    return utc(at.isoformat())


def clock(text: str) -> str:
    """Return a time in ISO 8601 as `10:12:03`, in UTC."""
    return utc(text).split()[1]


def duration(start: str, end: str) -> str:
    """Return the time between two times in ISO 8601, as `3 min 5 s`."""
    seconds = round((datetime.fromisoformat(end) - datetime.fromisoformat(start)).total_seconds())
    hours, rest = divmod(max(seconds, 0), 3600)
    minutes, seconds = divmod(rest, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def words(name: str) -> str:
    """Return a name in the records as words: viewpoint_skipped → viewpoint skipped."""
    return term(name)


def limit(verdict: GateVerdict) -> str:
    """Return the limits of a gate, as `≥ 0.2 and ≤ 1`."""
    return limits(verdict.minimum, verdict.maximum)


def measured(verdict: GateVerdict) -> tuple[str, str]:
    """Return the name of a gate's measure, and its value with the unit."""
    return measure_name(verdict.measure), figure(verdict)


_JUDGED: dict[Standing, TableCell] = {
    "within": TableCell("✓ passed", "ok"),
    "not_decided": TableCell("? not decided", "attention"),
    "accepted": TableCell("! accepted", "attention"),
    "outside": TableCell("✗ failed", "stop"),
}


def judged(verdict: GateVerdict, *, accepted: bool = False) -> TableCell:
    """Return a gate's verdict as a sign and a word with a tone. `accepted`: a person accepted the step's figures."""
    return _JUDGED[standing(verdict, accepted=accepted)]


def mm(value: float | None, digits: int = 3) -> str:
    """Return millimetres without the unit; `–` for None."""
    return "–" if value is None else f"{value:.{digits}f}"
