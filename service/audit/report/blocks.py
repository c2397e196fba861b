"""What a report is made of, as plain records: HTML and PDF are two ways to write the same."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

Tone = Literal["plain", "ok", "attention", "stop"]
Style = Literal["text", "number", "code"]


@dataclass(frozen=True, slots=True)
class Cell:
    """A text with how it is meant."""

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
    """Running text, or with a tone a statement that is set apart."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading within a section."""

    text: str


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and values, one below the other."""

    rows: tuple[tuple[str, Cell | str], ...]


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts. `strong`: indices of rows to be seen first; `spanning`: of rows that are one text throughout."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell | str, ...], ...]
    strong: frozenset[int] = frozenset()
    spanning: frozenset[int] = frozenset()
    small: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A small copy of a photograph with its caption; None where the file is missing or altered.

    The photograph itself is named by its hash: it lies in the evidence under that name.
    """

    caption: str
    jpeg: bytes | None
    width: int = 0
    height: int = 0
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class Pictures:
    """Photographs in so many columns."""

    items: tuple[Picture, ...]
    columns: int


@dataclass(frozen=True, slots=True)
class Box:
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
    """A text in a drawing; x, y: its base line at the anchor."""

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


Shape = Box | Line | Label | Raster


@dataclass(frozen=True, slots=True)
class Drawing:
    """A chart in its own units, drawn to the width that there is; `text` says the same in words.

    `name`: what its file is called, without an ending; `rows`: the figures that it draws, the first row their names
    with units.
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
    """Charts side by side, two a row."""

    items: tuple[Drawing, ...]


@dataclass(frozen=True, slots=True)
class Scene:
    """The scene: drawn as it is first seen, and to be turned in HTML; `html` is "" where that is not wanted."""

    drawing: Drawing
    html: str = field(repr=False)


Block = Paragraph | Heading | Facts | Table | Pictures | Drawings | Scene


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the report under its own number."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """The whole; the first six say on the first page what a reader must not miss."""

    title: str
    simulated: bool
    origin: Cell | None  # None: the run captured its photographs itself
    release: Cell | None  # None: the protocol asks for none
    verification: Cell
    result: Cell
    deviations: Cell
    facts: Facts
    sections: tuple[Section, ...]
    run_id: str
    head_sha256: str
    made_at: datetime  # UTC, to the second
