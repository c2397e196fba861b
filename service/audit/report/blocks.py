"""The content of a report as plain records, which are written as HTML or as PDF."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import ClassVar, Literal

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
    """A chart in its own units, scaled to the available width; `text` describes it in words.

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
