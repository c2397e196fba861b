"""The provenance graph laid out from left to right, as coordinates for an SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from service.audit.provenance.graph import Graph, Node
from service.jobs import job_kinds

BOX_WIDTH = 200
BOX_HEIGHT = 46
_COLUMN = 262
_ROW = 62
_MARGIN = 8
_SWEEPS = 6  # of ordering the rows
DRAWN = 70  # nodes; a larger graph is read in the list

Edge = tuple[str, str]  # keys of two nodes


@dataclass(frozen=True, slots=True)
class NodeBox:
    """A node and where it is drawn, in pixels."""

    node: Node
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class EdgeArrow:
    """An edge as a cubic curve."""

    path: str
    count: int
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class GraphDrawing:
    """The whole drawing and its size, in pixels."""

    width: float
    height: float
    boxes: list[NodeBox]
    arrows: list[EdgeArrow]
    left_out: int  # number of nodes that are only in the list


def draw(graph: Graph) -> GraphDrawing:
    """Lay out a graph: columns by the longest path from a source, rows so that the arrows are short."""
    ordered = graph.ordered()
    # Computations that only help during the capture lead to no result and would hide those that do.
    aside = {name for name, kind in job_kinds().items() if kind.aside}
    connected = {key for edge in graph.edges for key in edge if graph.nodes[key].kind not in aside}
    shown = [node for node in ordered if node.key in connected][:DRAWN]
    names = {node.key for node in shown}
    edges = [(a, b) for a, b in graph.edges if a in names and b in names]
    column = _columns(shown, edges)
    columns: dict[int, list[str]] = {}
    for node in shown:
        columns.setdefault(column[node.key], []).append(node.key)
    row = _rows(columns, edges, {node.key: index for index, node in enumerate(shown)})
    tallest = max((len(keys) for keys in columns.values()), default=0)
    boxes = [
        NodeBox(
            node,
            _MARGIN + column[node.key] * _COLUMN,
            _MARGIN + (row[node.key] + (tallest - len(columns[column[node.key]])) / 2) * _ROW,
        )
        for node in shown
    ]
    at = {box.node.key: box for box in boxes}
    arrows = [_arrow(at[a], at[b], graph.edges[a, b]) for a, b in edges]
    width = _MARGIN * 2 + max(columns, default=0) * _COLUMN + BOX_WIDTH
    return GraphDrawing(width, _MARGIN * 2 + tallest * _ROW, boxes, arrows, len(ordered) - len(shown))


def _columns(shown: Sequence[Node], edges: Sequence[Edge]) -> dict[str, int]:
    """The column of each node: after all of its sources. Nodes without a source stand just before their first use."""
    place = {node.key: index for index, node in enumerate(shown)}
    # A group may feed itself (registrations from registrations): such an edge is drawn but does not count here.
    ranking = sorted(((a, b) for a, b in edges if place[a] < place[b]), key=lambda edge: place[edge[0]])
    column = dict.fromkeys(place, 0)
    for node in shown:
        for a, b in ranking:
            if a == node.key:
                column[b] = max(column[b], column[a] + 1)
    for node in shown:
        uses = [column[b] for a, b in ranking if a == node.key]
        if uses and not any(b == node.key for _, b in ranking):
            column[node.key] = min(uses) - 1
    return column


def _rows(columns: Mapping[int, list[str]], edges: Sequence[Edge], place: Mapping[str, int]) -> dict[str, int]:
    """The row of each node in its column, near the mean row of its sources, in a few sweeps. Sorts `columns`."""
    row = {key: index for keys in columns.values() for index, key in enumerate(keys)}
    for _ in range(_SWEEPS):
        for number in sorted(columns):
            keys = columns[number]
            keys.sort(key=lambda key: (_mean([row[a] for a, b in edges if b == key] or [row[key]]), place[key]))
            row |= {key: index for index, key in enumerate(keys)}
    return row


def _mean(values: list[int]) -> float:
    return sum(values) / len(values)


def _arrow(a: NodeBox, b: NodeBox, count: int) -> EdgeArrow:
    x0, y0, x1, y1 = a.x + BOX_WIDTH, a.y + BOX_HEIGHT / 2, b.x, b.y + BOX_HEIGHT / 2
    bend = max(24.0, (x1 - x0) / 2) if x1 > x0 else 60.0
    path = f"M{x0:.0f} {y0:.0f}C{x0 + bend:.0f} {y0:.0f} {x1 - bend:.0f} {y1:.0f} {x1 - 5:.0f} {y1:.0f}"
    return EdgeArrow(path, count, a.node.key, b.node.key)
