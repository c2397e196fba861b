"""The provenance graph laid out from left to right: numbers for an SVG, nothing of the web."""

from __future__ import annotations

from dataclasses import dataclass

from service.audit.provenance.graph import Graph, Node
from service.jobs import job_kinds

BOX_WIDTH = 200
BOX_HEIGHT = 46
_COLUMN = 262
_ROW = 62
_MARGIN = 8
DRAWN = 70  # nodes; a larger graph is read in the list
# What helps during the capture and leads to no result: among all else it would hide what does.
_ASIDE = frozenset(name for name, kind in job_kinds().items() if kind.aside)


@dataclass(frozen=True, slots=True)
class Box:
    """A node and where it is drawn, in pixels."""

    node: Node
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Arrow:
    """An edge as a cubic curve."""

    path: str
    count: int
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """Everything, with its size."""

    width: float
    height: float
    boxes: list[Box]
    arrows: list[Arrow]
    left_out: int  # nodes that are in the list alone


def draw(graph: Graph) -> Drawing:
    """Columns by the longest way from a source; within a column in the order that keeps the arrows short."""
    ordered = graph.ordered()
    connected = {key for edge in graph.edges for key in edge if graph.nodes[key].kind not in _ASIDE}
    shown = [node for node in ordered if node.key in connected][:DRAWN]
    names = {node.key for node in shown}
    place = {node.key: index for index, node in enumerate(shown)}
    # A group may feed what made part of it (registrations from registrations): such an edge is drawn, not ranked.
    edges = [(a, b) for a, b in graph.edges if a in names and b in names]
    ranking = sorted(((a, b) for a, b in edges if place[a] < place[b]), key=lambda edge: place[edge[0]])
    column = dict.fromkeys(names, 0)
    for node in shown:
        for a, b in ranking:
            if a == node.key:
                column[b] = max(column[b], column[a] + 1)
    # Sources stand beside what first uses them.
    for node in shown:
        uses = [column[b] for a, b in ranking if a == node.key]
        if uses and not any(b == node.key for _, b in ranking):
            column[node.key] = min(uses) - 1
    columns: dict[int, list[str]] = {}
    for node in shown:
        columns.setdefault(column[node.key], []).append(node.key)
    row = {key: index for keys in columns.values() for index, key in enumerate(keys)}
    for _ in range(6):
        for number in sorted(columns):
            keys = columns[number]
            keys.sort(key=lambda key: (_mean([row[a] for a, b in edges if b == key] or [row[key]]), place[key]))
            row |= {key: index for index, key in enumerate(keys)}
    tallest = max((len(keys) for keys in columns.values()), default=0)
    boxes = [
        Box(
            node,
            _MARGIN + column[node.key] * _COLUMN,
            _MARGIN + (row[node.key] + (tallest - len(columns[column[node.key]])) / 2) * _ROW,
        )
        for node in shown
    ]
    at = {box.node.key: box for box in boxes}
    arrows = [_arrow(at[a], at[b], graph.edges[a, b]) for a, b in edges]
    width = _MARGIN * 2 + max(columns, default=0) * _COLUMN + BOX_WIDTH
    return Drawing(width, _MARGIN * 2 + tallest * _ROW, boxes, arrows, len(ordered) - len(shown))


def _mean(values: list[int]) -> float:
    return sum(values) / len(values)


def _arrow(a: Box, b: Box, count: int) -> Arrow:
    x0, y0, x1, y1 = a.x + BOX_WIDTH, a.y + BOX_HEIGHT / 2, b.x, b.y + BOX_HEIGHT / 2
    bend = max(24.0, (x1 - x0) / 2) if x1 > x0 else 60.0
    path = f"M{x0:.0f} {y0:.0f}C{x0 + bend:.0f} {y0:.0f} {x1 - bend:.0f} {y1:.0f} {x1 - 5:.0f} {y1:.0f}"
    return Arrow(path, count, a.node.key, b.node.key)
