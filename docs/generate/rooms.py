"""The rooms of service/, from one source: the layers that `make lint` holds, and the docstring of each room.

The table stands in the architecture page and in CONTRIBUTING, the layers in the picture of the architecture, between
marks that say so; `make reference` renews them.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
TABLE_PAGES = (ROOT / "docs" / "explanation" / "architecture.md", ROOT / "CONTRIBUTING.md")
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
_BEGIN, _END = "<!-- rooms: made by `make reference` -->", "<!-- end of rooms -->"
_LEFT, _WIDTH, _TOP, _GAP = 20, 920, 444, 8  # of the row of layers in the picture, px
_LINE = 17


def layers() -> list[list[str]]:
    """Return the rooms of each layer of service/, from the command line down to the core."""
    contracts: list[dict[str, Any]] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "importlinter"
    ]["contracts"]
    (service,) = (one for one in contracts if one.get("containers") == ["service"])
    return [[room.strip() for room in layer.split("|")] for layer in service["layers"]]


def rooms_table() -> str:
    """Return a Markdown table of all rooms, the upper layers first; each imports those of lower layers only."""
    rows = [f"| {number} | `{_path(room)}` | {_purpose(room)} |" for number, room in _numbered()]
    return "\n".join(["| layer | room | what it is |", "|---:|---|---|", *rows])


def pages_with_rooms() -> Mapping[Path, str]:
    """Return the text of each file that names the rooms, as it should be."""
    texts = {page: _replaced(page.read_text(encoding="utf-8"), f"\n{rooms_table()}\n") for page in TABLE_PAGES}
    picture = _replaced(PICTURE.read_text(encoding="utf-8"), "\n" + "\n".join(_drawn_layers()) + "\n")
    return {**texts, PICTURE: picture}


def _numbered() -> Iterator[tuple[int, str]]:
    for number, layer in enumerate(layers(), start=1):
        yield from ((number, room) for room in layer)


def _path(room: str) -> str:
    folder = ROOT / "service" / room
    return f"service/{room}/" if folder.is_dir() else f"service/{room}.py"


def _purpose(room: str) -> str:
    folder = ROOT / "service" / room
    module = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8"))) or ""
    words = " ".join(text.split("\n\n")[0].split()).rstrip(".").replace("|", "/")
    return words[:1].lower() + words[1:] if words[1:2].islower() else words


def _replaced(text: str, inner: str) -> str:
    between = re.compile(f"{re.escape(_BEGIN)}.*?{re.escape(_END)}", re.DOTALL)
    if not between.search(text):
        raise ValueError(f"a file of the rooms has no {_BEGIN} … {_END}")
    return between.sub(lambda _: f"{_BEGIN}{inner}{_END}", text)


def _drawn_layers() -> Iterator[str]:
    """Draw a box for each layer, the command line at the left."""
    drawn = layers()
    width = (_WIDTH - _GAP * (len(drawn) - 1)) / len(drawn)
    height = _LINE * max(map(len, drawn)) + 12
    for number, layer in enumerate(drawn):
        x = _LEFT + number * (width + _GAP)
        size = f'width="{width:.1f}" height="{height}"'
        yield f'<rect x="{x:.1f}" y="{_TOP}" {size} rx="4" fill="#f4f4f4" stroke="#999"/>'
        first = _TOP + height / 2 + 4 - _LINE * (len(layer) - 1) / 2
        for line, room in enumerate(layer):
            at = f'x="{x + width / 2:.1f}" y="{first + _LINE * line:.1f}"'
            yield f'<text {at} text-anchor="middle" font-size="11">{escape(room)}</text>'
