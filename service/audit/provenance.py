"""The provenance graph, files grouped by step and kind and the computations between them, and its drawing."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Connection, bindparam, text

from service.audit.background import IncrementalResults, PartialResult
from service.audit.queries import EventRow, artefacts_of_events, head, one_artefact, plain, plain_payload, read_rows
from service.computations import job_kinds
from service.core.jobs import Each, Reference, references_in
from service.core.records.run_events import FilesKept, JobEnqueued
from service.store.event_index import cut_words, matching
from service.store.events import parse_canonical
from service.store.records import Artefact
from service.store.store import Store

CHUNK = 500  # events in one step, after which waiting pages come first
_HASH = re.compile(r'"([0-9a-f]{64})"')
# Jobs of version 1 hold copies of earlier results (a camera, centres of spheres), found by their many digits.
_NUMBER = re.compile(r"-?\d+\.\d{12,}(?:e-?\d+)?")
_NUMBERS_A_JOB = 3000
_JOBS_A_KIND = 20  # jobs whose numbers are kept; jobs on thousands of views give no values to others
_KEPT_AS_IT_CAME = "kept "  # beginning of the note on a file that was kept undecoded


@dataclass(frozen=True, slots=True)
class Node:
    """Files of one kind from one step, or computations of one kind."""

    key: str
    is_job: bool
    step: str
    kind: str  # kind of the files, or of the jobs
    count: int
    first_seq: int
    failed: int = 0  # jobs that failed
    device: str = ""
    seqs: tuple[int, ...] = ()  # numbers of the first few events


@dataclass
class Graph:
    """Files and computations, and how many files pass along each edge (into computations: the most that one took)."""

    run_id: str
    seq: int = 0
    nodes: dict[str, Node] = field(default_factory=dict[str, Node])
    edges: dict[tuple[str, str], int] = field(default_factory=dict[tuple[str, str], int])
    by_value: set[tuple[str, str]] = field(
        default_factory=set[tuple[str, str]]
    )  # edges that carry numbers of a result, not files
    groups: dict[str, str] = field(default_factory=dict[str, str])  # SHA-256 → key of its node
    jobs: dict[str, str] = field(default_factory=dict[str, str])  # job → key of its node
    numbers: dict[str, str] = field(default_factory=dict[str, str])  # a number of a result → key of its job's node
    originals: dict[tuple[str, int, str], str] = field(default_factory=dict[tuple[str, int, str], str])

    def copy(self) -> Graph:
        """Return a copy that can be continued while pages read this one."""
        names = ("nodes", "edges", "groups", "jobs", "numbers", "originals")
        return replace(self, by_value=set(self.by_value), **{name: dict(getattr(self, name)) for name in names})

    def ordered(self) -> list[Node]:
        """Return the nodes in the order of their first events."""
        return sorted(self.nodes.values(), key=lambda node: (node.first_seq, not node.is_job, node.key))

    def sources(self, key: str) -> list[tuple[Node, int]]:
        """Return the nodes that feed a node, each with its number of files."""
        return [(self.nodes[a], n) for (a, b), n in self.edges.items() if b == key]

    def results(self, key: str) -> list[tuple[Node, int]]:
        """Return the nodes that a node feeds, each with its number of files."""
        return [(self.nodes[b], n) for (a, b), n in self.edges.items() if a == key]


def graphs(store: Store) -> IncrementalResults[Graph]:
    """Return graphs of a data folder's runs, updated in the background."""
    return IncrementalResults(store, lambda run_id, before: _step(store, run_id, before), "provenance")


def _step(store: Store, run_id: str, before: Graph | None) -> PartialResult[Graph]:
    graph = before or Graph(run_id)
    with store.database.reading() as connection:
        last, sha256 = head(connection, run_id)
        upto = min(graph.seq + CHUNK, last)
        values = {"run": plain(run_id), "after": graph.seq, "upto": upto}
        files = connection.execute(text(_FILES), values).all()
        jobs = connection.execute(text(_JOBS), values).all()
    both = [(row.seq, row.position, row, True) for row in files] + [(row.seq, -1, row, False) for row in jobs]
    for _seq, _position, row, is_file in sorted(both, key=lambda item: item[:2]):
        if is_file:
            _add_file(graph, row)
        else:
            _add_job(graph, row)
    graph.seq = upto
    return PartialResult(graph, upto, last, sha256)


_FILES = (
    "SELECT a.seq, a.position, a.sha256, a.kind, a.step, a.attempt, a.device, i.kind AS event, "
    "CASE i.kind WHEN 'job_finished' THEN (SELECT f.value FROM event_facets AS f "
    "WHERE f.run_id = a.run_id AND f.seq = a.seq AND f.name = 'job') WHEN 'files_kept' THEN (SELECT e.payload "
    "FROM events AS e WHERE e.run_id = a.run_id AND e.seq = a.seq) END AS how "
    "FROM artefacts AS a JOIN event_index AS i ON i.run_id = a.run_id AND i.seq = a.seq "
    "WHERE a.run_id = :run AND a.seq > :after AND a.seq <= :upto"
)
_JOBS = (
    "SELECT i.seq, i.kind AS event, i.step, e.payload, j.value AS job, k.value AS kind "
    "FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq "
    "LEFT JOIN event_facets AS j ON j.run_id = i.run_id AND j.seq = i.seq AND j.name = 'job' "
    "LEFT JOIN event_facets AS k ON k.run_id = i.run_id AND k.seq = i.seq AND k.name = 'job_kind' "
    "WHERE i.run_id = :run AND i.kind IN ('job_enqueued', 'job_finished', 'job_failed') "
    "AND i.seq > :after AND i.seq <= :upto"
)


def _add_file(graph: Graph, row: Any) -> None:
    job = graph.jobs.get(row.how or "") if row.event == "job_finished" else None
    made_by = f" by {graph.nodes[job].kind}" if job else ""
    key = f"file {row.step or ''} {row.kind}{made_by}"
    _count(graph, key, row, is_job=False)
    graph.groups.setdefault(row.sha256, key)
    if job:
        _connect(graph, job, key)
    elif row.event == "files_kept":
        place = (row.step or "", row.attempt or 0, row.device)
        if str(plain_payload(row.how).get("note") or "").startswith(_KEPT_AS_IT_CAME):
            graph.originals[place] = key
        elif place in graph.originals and graph.originals[place] != key:
            _connect(graph, graph.originals[place], key)


def _add_job(graph: Graph, row: Any) -> None:
    if row.event == "job_failed":
        key = graph.jobs.get(row.job)
        if key:
            graph.nodes[key] = replace(graph.nodes[key], failed=graph.nodes[key].failed + 1)
        return
    key = f"job {row.step or ''} {row.kind}"
    if row.event == "job_finished":
        if key in graph.nodes and graph.nodes[key].count <= _JOBS_A_KIND:
            for number in _NUMBER.findall(row.payload)[:_NUMBERS_A_JOB]:
                graph.numbers.setdefault(number, key)
        return
    _count(graph, key, row, is_job=True)
    graph.jobs[row.job] = key
    taken = Counter(graph.groups[name] for name in set(_HASH.findall(row.payload)) if name in graph.groups)
    for source, number in taken.items():
        graph.edges[source, key] = max(graph.edges.get((source, key), 0), number)
    enqueued = JobEnqueued.model_validate(parse_canonical(row.payload))
    if enqueued.version == 1:
        results = {graph.numbers[name] for name in _NUMBER.findall(row.payload) if name in graph.numbers} - {key}
    else:
        results = _referred_to(graph, enqueued.arguments, key)
    for source in results:
        graph.edges.setdefault((source, key), 0)
        graph.by_value.add((source, key))


def _referred_to(graph: Graph, arguments: Any, key: str) -> set[str]:
    """Return the nodes of jobs whose results the arguments refer to. Files that they refer to are added as edges."""
    results: set[str] = set()
    for _, reference in references_in(arguments):
        if isinstance(reference, Reference):
            sources = {graph.jobs[reference.job]} if reference.job in graph.jobs else set[str]()
        else:
            begun = (stem.split("/") for stem in reference.jobs)
            sources = {f"job {step} {kind}" for step, _, kind, *_ in begun} & graph.nodes.keys()
        if not reference.field.startswith("artefacts/"):
            results |= sources - {key}
            continue
        for file in [b for a, b in graph.edges if a in sources and not graph.nodes[b].is_job]:
            graph.edges[file, key] = max(graph.edges.get((file, key), 0), graph.nodes[file].count)
    return results


def _count(graph: Graph, key: str, row: Any, *, is_job: bool) -> None:
    node = graph.nodes.get(key)
    if node is None:
        device = "" if is_job else row.device
        node = Node(key, is_job, row.step or "", row.kind, 0, row.seq, device=device)
    seqs = node.seqs if len(node.seqs) >= 10 else (*node.seqs, row.seq)
    graph.nodes[key] = replace(node, count=node.count + 1, seqs=seqs)


def _connect(graph: Graph, source: str, target: str) -> None:
    graph.edges[source, target] = graph.edges.get((source, target), 0) + 1


# --- one artefact ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Origin:
    """The origin of a file, and what was made from it."""

    records: Sequence[Artefact]  # the first says where it came from
    event: EventRow  # the event that brought it
    job: EventRow | None  # job_enqueued event of the computation that made it
    inputs: Sequence[Artefact]  # the files that it was computed or decoded from
    input_count: int
    beside: Sequence[Artefact]  # other artefacts of the same event
    used_by: Sequence[EventRow]  # events that name it, LISTED of them at most
    made_of_it: Sequence[Artefact]  # results of computations that used it


LISTED = 50
_AT_ONCE = 1000  # files


def origin(connection: Connection, run_id: str, sha256: str) -> Origin:
    """Find what a file came from and what was made from it. Raises UnknownRunError if the run has no such file."""
    records = one_artefact(connection, run_id, sha256)
    (event,) = read_rows(connection, run_id, [records[0].seq], whole=True)
    job = _job_of(connection, run_id, event)
    inputs, count = _inputs(connection, run_id, job) if job else _decoded_from(connection, run_id, event, records[0])
    uses = [seq for seq in _naming(connection, run_id, sha256) if seq != event.seq]
    used_by = read_rows(connection, run_id, uses)
    brought = artefacts_of_events(connection, run_id, [event.seq])
    jobs = [row.job for row in used_by if row.kind == "job_enqueued"]
    return Origin(
        records=records,
        event=event,
        job=job,
        inputs=inputs,
        input_count=count,
        beside=[row for row in brought if row.ref.sha256 != sha256][:LISTED],
        used_by=used_by,
        made_of_it=artefacts_of_events(connection, run_id, sorted(_ends(connection, run_id, jobs)))[:LISTED],
    )


def _naming(connection: Connection, run_id: str, word: str, limit: int = LISTED) -> list[int]:
    """Return the events whose payload has this word."""
    positions, match = matching(connection, [cut_words(plain(word))])
    found = connection.execute(
        text(
            f"SELECT i.seq FROM ({positions}) AS w JOIN event_index AS i ON i.position = w.position "
            "WHERE i.run_id = :run ORDER BY i.position LIMIT :limit"
        ),
        {"run": plain(run_id), "match": match, "limit": limit},
    ).scalars()
    return list(found)


def _job_of(connection: Connection, run_id: str, event: EventRow) -> EventRow | None:
    if event.kind != "job_finished":
        return None
    named = read_rows(connection, run_id, _naming(connection, run_id, event.job), whole=True)
    return next((row for row in named if row.kind == "job_enqueued" and row.job == event.job), None)


def _ends(connection: Connection, run_id: str, jobs: Sequence[str]) -> Iterator[int]:
    for job in jobs:
        for row in read_rows(connection, run_id, _naming(connection, run_id, job)):
            if row.kind == "job_finished" and row.job == job:
                yield row.seq


def _inputs(connection: Connection, run_id: str, job: EventRow) -> tuple[list[Artefact], int]:
    named = list(dict.fromkeys([*_HASH.findall(job.shown), *_listed(connection, run_id, job)]))
    first_record = text(
        "SELECT min(seq * 1000 + position) AS place FROM artefacts WHERE run_id = :run "
        "AND sha256 IN :named GROUP BY sha256"
    ).bindparams(bindparam("named", expanding=True))
    places: list[int] = []
    for start in range(0, len(named), _AT_ONCE):
        values = {"run": plain(run_id), "named": named[start : start + _AT_ONCE]}
        places += connection.execute(first_record, values).scalars()
    places.sort()
    first = artefacts_of_events(connection, run_id, sorted({place // 1000 for place in places[:LISTED]}))
    return [row for row in first if row.ref.sha256 in set(named)][:LISTED], len(places)


def _listed(connection: Connection, run_id: str, job: EventRow) -> Iterator[str]:
    """Yield the files of the many earlier jobs that a job refers to at once."""
    enqueued = job.record(JobEnqueued)
    for _, each in references_in({} if enqueued is None else enqueued.arguments):
        if isinstance(each, Each) and each.field.startswith("artefacts/"):
            for stem in each.jobs:
                yield from connection.execute(
                    text(
                        "SELECT a.sha256 FROM jobs AS j JOIN artefacts AS a ON a.run_id = j.run_id "
                        "AND a.seq = j.ended_seq WHERE j.run_id = :run AND j.state = 'finished' "
                        "AND j.ended_seq <= :upto AND substr(j.idempotency_key, 1, :length) = :stem "
                        "AND a.position = 0 ORDER BY j.enqueued_seq"
                    ),
                    {"run": plain(run_id), "upto": each.upto_seq, "length": len(stem), "stem": stem},
                ).scalars()


def _decoded_from(connection: Connection, run_id: str, event: EventRow, row: Artefact) -> tuple[list[Artefact], int]:
    """Find the originals of a file that a driver decoded: those stored before it in the same step from its device."""
    kept = event.record(FilesKept)
    if kept is None or kept.note.startswith(_KEPT_AS_IT_CAME):
        return [], 0
    seqs = connection.execute(
        text(
            "SELECT seq FROM artefacts WHERE run_id = :run AND step = :step AND attempt = :attempt "
            "AND device = :device AND kind <> :kind AND seq < :seq ORDER BY seq"
        ),
        {
            "run": plain(run_id),
            "step": row.step,
            "attempt": row.attempt,
            "device": row.device,
            "kind": row.ref.kind,
            "seq": row.seq,
        },
    ).scalars()
    found = list(seqs)
    return artefacts_of_events(connection, run_id, found[:LISTED]), len(found)


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
    """Return the column of each node: after all of its sources.

    Nodes without a source stand just before their first use.
    """
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
    """Return the row of each node in its column, near the mean row of its sources, in a few sweeps.

    Sorts `columns`.
    """
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
