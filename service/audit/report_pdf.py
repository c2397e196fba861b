"""A report as PDF on A4: for the file, for the post, and for whoever has no browser at hand."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from reportlab.graphics.shapes import Drawing as Sheet
from reportlab.graphics.shapes import Line as SheetLine
from reportlab.graphics.shapes import Rect, String
from reportlab.lib.colors import HexColor
from reportlab.lib.enums import TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import CondPageBreak, Flowable, Image, KeepTogether, SimpleDocTemplate, Spacer
from reportlab.platypus import Paragraph as Text
from reportlab.platypus import Table as Grid

from service.audit.report_blocks import (
    Box,
    Cell,
    Drawing,
    Drawings,
    Facts,
    Heading,
    Line,
    Paragraph,
    Picture,
    Pictures,
    Report,
    Scene,
    Section,
    Style,
    Table,
    Tone,
)

_Body = Paragraph | Facts | Table | Pictures | Drawings | Scene  # a block that is no heading
_MARGIN = 18 * mm
_WIDTH = A4[0] - 2 * _MARGIN
_INK, _QUIET, _HAIR, _STRONG = HexColor("#1a1f24"), HexColor("#52606d"), HexColor("#d5dbe1"), HexColor("#f3f6f9")
_TONES = {"plain": "#1a1f24", "ok": "#0d5225", "attention": "#6b4a00", "stop": "#8a1010"}
_GROUNDS = {"ok": HexColor("#e6f4ea"), "attention": HexColor("#fdf3d8"), "stop": HexColor("#fbe3e3")}
_KEPT_ROWS = 12  # tables no longer than this stay on one page
# DejaVu has every sign that a report writes. Where it is not installed, the fonts that every PDF reader has take its
# place, with their symbol font for Greek and mathematics.
_FONT_FOLDERS = (
    "/usr/share/fonts/truetype/dejavu",
    "/usr/share/fonts/dejavu",
    "/usr/share/fonts/dejavu-sans-fonts",
    "/usr/share/fonts/TTF",
    "/usr/local/share/fonts",
)
_FILES = {"regular": "DejaVuSans.ttf", "bold": "DejaVuSans-Bold.ttf", "code": "DejaVuSansMono.ttf"}
_STANDARD = {"regular": "Helvetica", "bold": "Helvetica-Bold", "code": "Courier"}


@dataclass(frozen=True, slots=True)
class _Styles:
    fonts: dict[str, str]

    def style(self, size: float, face: str = "regular", **more: Any) -> ParagraphStyle:
        return ParagraphStyle(
            name=f"{face}{size}",
            fontName=self.fonts[face],
            fontSize=size,
            leading=1.36 * size,
            textColor=more.pop("color", _INK),
            **more,
        )


def write_pdf(report: Report, path: Path) -> None:
    """Write the file, and its folder where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(render_pdf(report))


def render_pdf(report: Report) -> bytes:
    """The whole document; the same report gives the same bytes wherever the same fonts are."""
    styles = _Styles(_fonts())
    out = io.BytesIO()
    document = SimpleDocTemplate(
        out,
        pagesize=A4,
        leftMargin=_MARGIN - 6,  # the frame adds so much
        rightMargin=_MARGIN - 6,
        topMargin=16 * mm,
        bottomMargin=20 * mm,
        title=f"orthocapture: run {report.run_id}",
        author="orthocapture",
        subject=report.title,
        invariant=1,
    )
    story = [*_front(report, styles)]
    for number, section in enumerate(report.sections, 1):
        story += _section(section, number, styles)
    document.build(story, canvasmaker=partial(_NumberedCanvas, report=report, fonts=styles.fonts))
    return out.getvalue()


def _fonts() -> dict[str, str]:
    for folder in map(Path, _FONT_FOLDERS):
        if all((folder / file).is_file() for file in _FILES.values()):
            for face, file in _FILES.items():
                pdfmetrics.registerFont(TTFont(f"report-{face}", str(folder / file)))
            names = {face: f"report-{face}" for face in _FILES}
            pdfmetrics.registerFontFamily(
                names["regular"],
                normal=names["regular"],
                bold=names["bold"],
                italic=names["regular"],
                boldItalic=names["bold"],
            )
            return names
    return dict(_STANDARD)


class _NumberedCanvas(Canvas):
    """Writes the foot of every page once it is known how many there are."""

    def __init__(self, *args: Any, report: Report, fonts: dict[str, str], **more: Any) -> None:
        super().__init__(*args, **more)
        self._report = report
        self._faces = fonts
        self._pages: list[dict[str, Any]] = []

    def showPage(self) -> None:
        """Hold the page back."""
        self._pages.append(dict(self.__dict__))
        self._startPage()  # pyright: ignore[reportAttributeAccessIssue] - its own way to begin a page

    def save(self) -> None:
        """Write all pages."""
        for number, page in enumerate(self._pages, 1):
            self.__dict__.update(page)
            self._foot(number, len(self._pages))
            super().showPage()
        super().save()

    def _foot(self, number: int, total: int) -> None:
        self.setStrokeColor(_HAIR)
        self.setLineWidth(0.5)
        self.line(_MARGIN, 14 * mm, A4[0] - _MARGIN, 14 * mm)
        self.setFillColor(_QUIET)
        self.setFont(self._faces["regular"], 7)
        simulated = "SIMULATED · " if self._report.simulated else ""
        self.drawString(_MARGIN, 10.5 * mm, f"{simulated}Run {self._report.run_id} · made {self._report.made_utc}")
        self.drawRightString(A4[0] - _MARGIN, 10.5 * mm, f"{number} of {total}")
        self.setFont(self._faces["code"], 6)
        self.drawString(_MARGIN, 7.5 * mm, f"chain head {self._report.head_sha256}")


def _front(report: Report, styles: _Styles) -> Iterator[Flowable]:
    yield Text("orthocapture · report of a run", styles.style(9, color=_QUIET))
    yield Spacer(1, 3 * mm)
    yield Text(escape(report.title), styles.style(19, "bold"))
    yield Spacer(1, 3 * mm)
    if report.simulated:
        yield Text("SIMULATED", styles.style(34, "bold", color=HexColor(_TONES["stop"])))
        quiet = styles.style(9.5, color=HexColor(_TONES["stop"]))
        yield Text("A simulated rig: not a real capture. Nothing here was measured on a specimen.", quiet)
        yield Spacer(1, 4 * mm)
    first: tuple[Cell, ...] = ()
    if report.release is not None and report.release.tone == "stop":
        large, _, small = report.release.text.partition(": ")
        yield Text(escape(large), styles.style(34, "bold", color=HexColor(_TONES["stop"])))
        yield Text(escape(f"{small[:1].upper()}{small[1:]}."), styles.style(9.5, color=HexColor(_TONES["stop"])))
        yield Spacer(1, 4 * mm)
    elif report.release is not None:
        first = (report.release,)
    if report.origin is not None:
        first = (*first, report.origin)
    for statement in (*first, report.verification, report.deviations, report.result):
        end = "" if statement.text.endswith(".") else "."
        yield _statement(Cell(statement.text + end, statement.tone), styles, 10)
        yield Spacer(1, 2 * mm)
    yield Spacer(1, 3 * mm)
    yield _facts(report.facts, styles)
    yield Spacer(1, 4 * mm)


def _section(section: Section, number: int, styles: _Styles) -> Iterator[Flowable]:
    title = Text(f"{number}&nbsp;&nbsp;{escape(section.title)}", styles.style(13, "bold"))
    headed: list[Flowable] = [Spacer(1, 6 * mm), title, Spacer(1, 2.5 * mm)]
    for block in section.blocks:
        if isinstance(block, Heading):
            headed += [Spacer(1, 2.5 * mm), Text(escape(block.text), styles.style(9.5, "bold")), Spacer(1, 1.5 * mm)]
            continue
        first, *others = _block(block, styles)
        # A heading stays with what follows it; a long table begins where there is room for some of it.
        if isinstance(block, Table) and len(block.rows) > _KEPT_ROWS:
            yield from (CondPageBreak(50 * mm), *headed, first)
        else:
            yield KeepTogether([*headed, first]) if headed or isinstance(block, Table) else first
        yield from others
        headed = []


def _block(block: _Body, styles: _Styles) -> Iterator[Flowable]:
    match block:
        case Paragraph(text, "plain"):
            yield Text(escape(text), styles.style(8.5))
            yield Spacer(1, 2 * mm)
        case Paragraph(text, tone):
            yield _statement(Cell(text, tone), styles, 8.5)
            yield Spacer(1, 2 * mm)
        case Facts():
            yield _facts(block, styles)
            yield Spacer(1, 2 * mm)
        case Table():
            yield _table(block, styles)
            yield Spacer(1, 3 * mm)
        case Pictures():
            yield from _pictures(block, styles)
        case Drawings():
            yield from _drawings(block, styles)
        case Scene(_html, text):
            yield Text(escape(f"{text} The HTML report shows them in 3D."), styles.style(8.5))


def _statement(cell: Cell, styles: _Styles, size: float) -> Flowable:
    face = "bold" if cell.tone == "stop" else "regular"
    text = Text(escape(cell.text), styles.style(size, face, color=HexColor(_TONES[cell.tone])))
    grid = Grid([[text]], colWidths=[_WIDTH])
    grid.setStyle(
        [
            ("BACKGROUND", (0, 0), (-1, -1), _GROUNDS.get(cell.tone, _STRONG)),
            ("LINEBEFORE", (0, 0), (0, -1), 3, HexColor(_TONES[cell.tone])),
            ("LEFTPADDING", (0, 0), (-1, -1), 9),
            ("TOPPADDING", (0, 0), (-1, -1), 4),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 5),
        ]
    )
    return grid


def _text(value: Cell | str, size: float, style: Style, styles: _Styles, *, strong: bool = False) -> Text:
    tone: Tone = "plain" if isinstance(value, str) else value.tone
    content = value if isinstance(value, str) else value.text
    face = "code" if style == "code" else "bold" if strong or tone == "stop" else "regular"
    more = {"alignment": TA_RIGHT} if style == "number" else {}
    return Text(escape(content), styles.style(size, face, color=HexColor(_TONES[tone]), splitLongWords=1, **more))


_CELLS = [
    ("VALIGN", (0, 0), (-1, -1), "TOP"),
    ("TOPPADDING", (0, 0), (-1, -1), 2),
    ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
    ("LEFTPADDING", (0, 0), (-1, -1), 3),
    ("RIGHTPADDING", (0, 0), (-1, -1), 3),
    ("LEFTPADDING", (0, 0), (0, -1), 0),
    ("LINEBELOW", (0, 0), (-1, -1), 0.4, _HAIR),
]


def _facts(facts: Facts, styles: _Styles) -> Flowable:
    quiet = styles.style(8, color=_QUIET)
    rows = [[Text(escape(name), quiet), _text(value, 8, _style_of(value), styles)] for name, value in facts.rows]
    grid = Grid(rows, colWidths=[0.3 * _WIDTH, 0.7 * _WIDTH])
    grid.setStyle(_CELLS)
    return grid


def _style_of(value: Cell | str) -> Style:
    """A hash alone is easier to compare in a typeface of fixed width."""
    content = value if isinstance(value, str) else value.text
    return "code" if len(content) == 64 and " " not in content else "text"


def _table(table: Table, styles: _Styles) -> Flowable:
    size = 6.8 if table.small else 7.4
    whole = sum(column.share for column in table.columns)
    headed = any(column.heading for column in table.columns)
    rows: list[list[Text]] = []
    if headed:
        rows.append(
            [
                Text(
                    escape(column.heading),
                    styles.style(size, "bold", color=_QUIET, alignment=TA_RIGHT if column.style == "number" else 0),
                )
                for column in table.columns
            ]
        )
    for number, row in enumerate(table.rows):
        strong = number in table.strong
        cells = zip(row, table.columns, strict=True)
        rows.append(
            [_text(v, 0.88 * size if c.style == "code" else size, c.style, styles, strong=strong) for v, c in cells]
        )
    grid = Grid(rows, colWidths=[_WIDTH * c.share / whole for c in table.columns], repeatRows=int(headed))
    grounds = [("BACKGROUND", (0, n + int(headed)), (-1, n + int(headed)), _STRONG) for n in sorted(table.strong)]
    # A step's row stays with the first row of what belongs to it.
    kept = [("NOSPLIT", (0, n + int(headed)), (-1, n + int(headed) + 1)) for n in sorted(table.strong)]
    spans = [("SPAN", (0, n + int(headed)), (-1, n + int(headed))) for n in sorted(table.spanning)]
    padded = [("LEFTPADDING", (0, n + int(headed)), (0, n + int(headed)), 4) for n in sorted(table.spanning)]
    grid.setStyle([*_CELLS, *grounds, *padded, *spans, *[rule for rule in kept if rule[2][1] < len(rows)]])
    return grid


def _pictures(pictures: Pictures, styles: _Styles) -> Iterator[Flowable]:
    columns = pictures.columns
    width = _WIDTH / columns
    for start in range(0, len(pictures.items), columns):
        row = [_picture(p, width - 6, styles) for p in pictures.items[start : start + columns]]
        row += [[Spacer(1, 1)]] * (columns - len(row))
        grid = Grid([row], colWidths=[width] * columns)
        grid.setStyle(
            [
                ("VALIGN", (0, 0), (-1, -1), "TOP"),
                ("LEFTPADDING", (0, 0), (-1, -1), 0),
                ("RIGHTPADDING", (0, 0), (-1, -1), 6),
            ]
        )
        yield grid
    yield Spacer(1, 2 * mm)


def _picture(picture: Picture, width: float, styles: _Styles) -> Sequence[Flowable]:
    caption = Text(escape(picture.caption), styles.style(6.5, color=_QUIET))
    if picture.jpeg is None:
        return [caption]
    return [Image(io.BytesIO(picture.jpeg), width, width * picture.height / picture.width), Spacer(1, 1), caption]


def _drawings(drawings: Drawings, styles: _Styles) -> Iterator[Flowable]:
    width = _WIDTH / 2
    for start in range(0, len(drawings.items), 2):
        row = [
            [
                _sheet(drawing, width - 12, styles),
                Spacer(1, 2),
                Text(f"<b>{escape(drawing.title)}.</b> {escape(drawing.text)}", styles.style(7)),
            ]
            for drawing in drawings.items[start : start + 2]
        ]
        row += [[Spacer(1, 1)]] * (2 - len(row))
        grid = Grid([row], colWidths=[width] * 2)
        grid.setStyle(
            [
                ("VALIGN", (0, 0), (-1, -1), "TOP"),
                ("LEFTPADDING", (0, 0), (-1, -1), 0),
                ("RIGHTPADDING", (0, 0), (-1, -1), 12),
            ]
        )
        yield grid
        yield Spacer(1, 3 * mm)


def _sheet(drawing: Drawing, width: float, styles: _Styles) -> Sheet:
    scale = width / drawing.width
    height = drawing.height * scale
    sheet = Sheet(width, height)
    for shape in drawing.shapes:
        if isinstance(shape, Box):
            y = height - (shape.y + shape.height) * scale
            sheet.add(
                Rect(
                    shape.x * scale, y, shape.width * scale, shape.height * scale,
                    fillColor=HexColor(shape.colour),  # pyright: ignore[reportArgumentType] - the stub is wrong
                    strokeColor=None,  # pyright: ignore[reportArgumentType] - the stub is wrong
                )
            )  # fmt: skip
        elif isinstance(shape, Line):
            sheet.add(
                SheetLine(
                    shape.x1 * scale, height - shape.y1 * scale, shape.x2 * scale, height - shape.y2 * scale,
                    strokeColor=HexColor(shape.colour), strokeWidth=shape.width * scale,
                )
            )  # fmt: skip
        else:
            sheet.add(
                String(
                    shape.x * scale, height - shape.y * scale, shape.text, fontName=styles.fonts["regular"],
                    fontSize=shape.size * scale, fillColor=HexColor(shape.colour), textAnchor=shape.anchor,
                )
            )  # fmt: skip
    return sheet
