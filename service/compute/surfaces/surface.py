"""Holds a surface as arrays, reads and writes it as PLY, and measures distances from points to it and to points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree
from scipy.ndimage import distance_transform_cdt

from service.core.errors import DataError
from service.core.geometry import Array, Transform, apply

IntArray = NDArray[np.int64]
FACES = 25_000  # in a block, so that what is computed of its corners stays in the processor's cache


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) in metres with faces (F, 3), or points with (0, 3) faces and perhaps unit normals (V, 3)."""

    vertices_m: Array = field(repr=False)
    faces: IntArray = field(repr=False)
    normals: Array | None = field(default=None, repr=False)

    @classmethod
    def kept(cls, path: Path) -> Surface:
        """Return the mesh of a CT or a scan as an import keeps it: an .npz file of `vertices_m` and `faces`."""
        with np.load(path, allow_pickle=False) as mesh:
            return cls(mesh["vertices_m"].astype(np.float64, copy=False), mesh["faces"])  # their integers are short

    @property
    def is_mesh(self) -> bool:
        """True if the surface has faces."""
        return len(self.faces) > 0

    @cached_property
    def area_vectors_m2(self) -> Array:
        """(F, 3) outward normal of each face, as long as its area."""
        out = np.empty((len(self.faces), 3))
        for block in self.blocks():
            out[block] = self.area_vectors_of(block)
        return out

    def blocks(self) -> Iterator[slice]:
        """Yield the faces in blocks, in order."""
        for begin in range(0, len(self.faces), FACES):
            yield slice(begin, min(begin + FACES, len(self.faces)))

    def touching(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (F,) which faces have one of the chosen (V,) vertices."""
        one, other, third = self.faces.T
        return chosen[one] | chosen[other] | chosen[third]

    def area_vectors_of(self, chosen: IntArray | slice) -> Array:
        """Return (N, 3) `area_vectors_m2` of some faces alone."""
        corners = self.faces[chosen]
        out = np.empty((len(corners), 3))
        for begin in range(0, len(corners), FACES):
            part = slice(begin, begin + FACES)
            a, b, c = (self.vertices_m[corners[part, k]] for k in range(3))
            out[part] = 0.5 * np.cross(b - a, c - a)
        return out

    def normals_of(self, chosen: IntArray | slice) -> Array:
        """Return (N, 3) unit normals of some faces; zero for faces without area."""
        vectors = self.area_vectors_of(chosen)
        return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)

    @cached_property
    def face_areas_m2(self) -> Array:
        """(F,) area of each face."""
        out = np.empty(len(self.faces))
        for block in self.blocks():
            out[block] = np.linalg.norm(self.area_vectors_of(block), axis=1)
        return out

    @cached_property
    def face_normals(self) -> Array:
        """(F, 3) unit normals; zero for faces without area."""
        return self.normals_of(slice(None))

    @cached_property
    def vertex_normals(self) -> Array:
        """(V, 3) area-weighted unit normals; zero for vertices without faces."""
        total = self.sums_at_vertices(self.area_vectors_of)
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)

    def sums_at_vertices(self, of_faces: Callable[[slice], Array]) -> Array:
        """Sum (V, K), over the faces around each vertex, what a function gives for a block of faces (N, K)."""
        total: Array | None = None
        for block in self.blocks():
            values = of_faces(block)
            if total is None:
                total = np.zeros((len(self.vertices_m), values.shape[1]))
            corner = self.faces[block].ravel()
            for k in range(values.shape[1]):
                np.add.at(total[:, k], corner, np.repeat(values[:, k], 3))
        return np.zeros((len(self.vertices_m), 3)) if total is None else total

    @cached_property
    def area_m2(self) -> float:
        """Area of all faces."""
        return float(self.face_areas_m2.sum())

    def moved(self, T_a_b: Transform) -> Surface:
        """Return this surface, of frame b, in frame a."""
        normals = None if self.normals is None else self.normals @ T_a_b[:3, :3].T
        return Surface(apply(T_a_b, self.vertices_m), self.faces, normals)


_STORED = {"f": "<f4", "u": "u1", "b": "u1"}
_NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar"}
_KINDS = {name: kind for kind, name in _NAMES.items()}
_ROWS = 500_000  # written at a time
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_ply(
    path: Path,
    surface: Surface,
    metres_per_unit: float,
    properties: Mapping[str, NDArray[np.generic]],
    comments: Sequence[str] = (),
) -> None:
    """Write a surface.

    Args:
        path: the file to write.
        surface: metres.
        metres_per_unit: unit of the file's coordinates.
        properties: (V,) numbers for each name: fractional ones are written as float, others as unsigned bytes.
        comments: lines for the header, in ASCII.
    """
    columns = {name: surface.vertices_m[:, k] / metres_per_unit for k, name in enumerate("xyz")}
    columns |= {name: np.asarray(values) for name, values in properties.items()}
    stored = {name: values.astype(_STORED[values.dtype.kind]) for name, values in columns.items()}
    with path.open("wb") as file:
        file.writelines(_ply_blocks(stored, surface.faces, comments))


def ply_bytes(
    columns: Mapping[str, NDArray[np.generic]], faces: NDArray[np.integer], comments: Sequence[str] = ()
) -> bytes:
    """Encode a binary, little-endian PLY.

    Args:
        columns: (V,) float32, float64 or uint8 for each property of the vertices, x, y and z first.
        faces: (F, 3) indices of vertices.
        comments: lines for the header, in ASCII.
    """
    return b"".join(_ply_blocks(columns, faces, comments))


def _ply_blocks(
    columns: Mapping[str, NDArray[np.generic]], faces: NDArray[np.integer], comments: Sequence[str]
) -> Iterator[bytes]:
    """Yield the file in blocks."""
    kinds = {name: values.dtype.newbyteorder("<").str for name, values in columns.items()}
    vertices = len(columns["x"])
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {vertices}",
        *(f"property {_NAMES[kind]} {name}" for name, kind in kinds.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    yield ("\n".join(lines) + "\n").encode("ascii")
    for begin in range(0, vertices, _ROWS):
        vertex = np.zeros(min(_ROWS, vertices - begin), dtype=list(kinds.items()))
        for name, values in columns.items():
            vertex[name] = values[begin : begin + _ROWS]
        yield vertex.tobytes()
    for begin in range(0, len(faces), _ROWS):
        face = np.zeros(min(_ROWS, len(faces) - begin), dtype=_FACE)
        face["count"], face["vertices"] = 3, faces[begin : begin + _ROWS]
        yield face.tobytes()


def read_ply(path: Path) -> tuple[dict[str, NDArray[np.generic]], IntArray]:
    """Read the properties of the vertices (V,) by name, and the faces (F, 3), of a file that this module wrote.

    Raises:
        DataError: another program wrote the file, or its end is missing.
    """
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    kinds: list[tuple[str, str]] = []
    counts: dict[str, int] = {}
    try:
        for words in (line.split() for line in head.decode("ascii").splitlines()):
            if words[0] == "element":
                counts[words[1]] = int(words[2])
            elif words[0] == "property" and words[1] != "list":
                kinds.append((words[2], _KINDS[words[1]]))
        vertex = np.frombuffer(body, dtype=kinds, count=counts["vertex"])
        face = np.frombuffer(body, dtype=_FACE, count=counts["face"], offset=vertex.nbytes)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        raise DataError(
            "no PLY file of this program, or cut short", where=str(path), remedy="Write it again"
        ) from error
    return {name: vertex[name] for name, _ in kinds}, face["vertices"].astype(np.int64)


_CHUNK = 1_000_000  # queries at a time, which limits the memory
_PROBE = 4096  # consecutive points by which to decide whether their order is spatial
_NEAR = 0.02  # of the extent: a usual step between consecutive points in spatial order is shorter
_CELLS = 128  # along the longest side of a block of points, in the grid that says how far it is
_GROUP = 4096  # queries that lie together
_TOGETHER = 25_000  # points whose cells are found at a time, which fits into the processor's cache


class PointIndex:
    """Points (N, 3) in which the nearest to any place can be found."""

    def __init__(self, points_m: Array) -> None:
        self._order = spatial_order(points_m)
        points = points_m if self._order is None else points_m[self._order]
        self._tree = KDTree(np.ascontiguousarray(points, dtype=np.float64))

    def nearest(self, queries_m: Array, within_m: float = np.inf) -> tuple[Array, IntArray]:
        """Return the distance (Q,) in metres from each query (Q, 3) to the nearest point, and that point's index.

        With no point nearer than `within_m`, the distance is infinite and the index -1. A bound makes the search
        many times faster for queries that are far from all points.
        """
        order = spatial_order(queries_m)
        distance, index = np.empty(len(queries_m)), np.empty(len(queries_m), dtype=np.int64)
        for begin in range(0, len(queries_m), _CHUNK):
            end = min(begin + _CHUNK, len(queries_m))
            part: slice | IntArray = slice(begin, end) if order is None else order[begin:end]
            queries = np.ascontiguousarray(queries_m[part], dtype=np.float64)
            d, i = self._tree.query(queries, distance_upper_bound=within_m)
            distance[part] = d
            found = np.isfinite(d)
            i[~found] = 0
            index[part] = i if self._order is None else self._order[i]
            if not found.all():
                index[part] = np.where(found, index[part], -1)
        return distance, index

    def neighbours(self, queries_m: Array, k: int) -> IntArray:
        """Return (Q, k) indices of the k points nearest to each query (Q, 3), the nearest first."""
        index = self._tree.query(np.ascontiguousarray(queries_m, dtype=np.float64), k=k)[1].astype(np.int64)
        return index if self._order is None else self._order[index]


class NearestOfBlocks:
    """The nearest of many points that are shown block by block, so that never all of them are in memory.

    Attributes:
        distance_m: (Q,) distance from each query to the nearest point shown so far; infinite if none is within the
            limit.
        label: (Q,) label of that point; -1 if there is none.
    """

    def __init__(self, queries_m: Array, within_m: float = np.inf) -> None:
        self.distance_m = np.full(len(queries_m), np.inf)
        self.label = np.full(len(queries_m), -1, dtype=np.int64)
        self._queries, self._within = queries_m, within_m
        # Queries that lie together are looked at together: most of them are far from most blocks.
        order = z_order(queries_m) if len(queries_m) else np.zeros(0, dtype=np.int64)
        self._groups = [order[begin : begin + _GROUP] for begin in range(0, len(order), _GROUP)]
        boxes = [(queries_m[group].min(axis=0), queries_m[group].max(axis=0)) for group in self._groups]
        low, high = np.array(boxes).reshape(-1, 2, 3).swapaxes(0, 1)
        self._middles, self._radii = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)

    def asked(self, block: Block) -> IntArray:
        """Return the indices of the queries to which a point of a block may be the nearest."""
        reach = np.array([float(self.distance_m[group].max()) for group in self._groups])
        near = np.flatnonzero(block.least_distance(self._middles) - self._radii < np.minimum(reach, self._within))
        found: list[IntArray] = [np.zeros(0, dtype=np.int64)]
        for group in (self._groups[k] for k in near):
            least = block.least_distance(self._queries[group])
            found.append(group[least < np.minimum(self.distance_m[group], self._within)])
        return np.concatenate(found)

    def look(self, asked: IntArray, points: PointIndex, labels: IntArray) -> None:
        """Look among further points, with their labels (N,), for these queries."""
        distance, index = points.nearest(self._queries[asked], self._within)
        nearer = distance < self.distance_m[asked]
        at = asked[nearer]
        self.distance_m[at], self.label[at] = distance[nearer], labels[index[nearer]]


def show(points_m: Array, labels: IntArray, to: Sequence[NearestOfBlocks]) -> None:
    """Show a block of points (N, 3), with their labels (N,), to all who look for the nearest."""
    block = Block(points_m)
    index: PointIndex | None = None
    for nearest in to:
        asked = nearest.asked(block)
        if len(asked):
            index = index or PointIndex(points_m)
            nearest.look(asked, index, labels)


class Block:
    """A coarse grid of points (N, 3), which says how far they are at least."""

    def __init__(self, points_m: Array) -> None:
        self._low, self._high = points_m.min(axis=0), points_m.max(axis=0)
        self._cell = max(float(np.max(self._high - self._low)) / _CELLS, 1e-300)
        self._size = np.floor((self._high - self._low) / self._cell).astype(np.int64) + 1
        empty = np.ones(int(np.prod(self._size)), dtype=np.bool_)
        for begin in range(0, len(points_m), _TOGETHER):
            part = points_m[begin : begin + _TOGETHER]
            empty[self._cells([part[:, k] for k in range(3)])] = False
        # Cells that are n apart along one of the axes have at least n - 1 between them.
        apart = np.asarray(distance_transform_cdt(empty.reshape(tuple(self._size)), metric="chessboard"))
        self._apart = self._cell * np.maximum(apart.ravel() - 1.0, 0.0)

    def _cells(self, inside: Sequence[Array]) -> IntArray:
        """Return (N,) the number of the cell of each place, given by its three coordinates (N,)."""
        number = np.zeros(len(inside[0]), dtype=np.int64)
        for x, low, size in zip(inside, self._low, self._size, strict=True):
            number = number * size + np.minimum((x - low) / self._cell, size - 1).astype(np.int64)
        return number

    def least_distance(self, places_m: Array) -> Array:
        """Return (Q,) a distance than which no point of the block is nearer to a place (Q, 3)."""
        inside = [np.clip(places_m[:, k], self._low[k], self._high[k]) for k in range(3)]
        # The box is convex: the way to a point in it is at least as long as both legs of a right angle.
        beside = sum(((places_m[:, k] - inside[k]) ** 2 for k in range(3)), self._apart[self._cells(inside)] ** 2)
        return np.sqrt(beside) * (1 - 1e-9)


def spatial_order(points: Array) -> IntArray | None:
    """Return an order (N,) along a Z curve; None if consecutive points (N, 3) are mostly neighbours already."""
    if len(points) < _PROBE:
        return None
    begin = np.linspace(0, len(points) - 2, _PROBE).astype(np.int64)
    extent = float(np.max(np.ptp(points[begin], axis=0)))  # nearly that of all points, and much faster
    steps = np.linalg.norm(points[begin + 1] - points[begin], axis=1)
    if extent == 0 or float(np.median(steps)) < _NEAR * extent:
        return None
    return z_order(points)


def z_order(points: Array) -> IntArray:
    """Return the order (N,) of points (N, 3) along a Z curve, so that neighbours are mostly near one another."""
    low = points.min(axis=0)
    extent = max(float(np.max(points.max(axis=0) - low)), 1e-300)
    keys = np.empty(len(points), dtype=np.uint64)
    for begin in range(0, len(points), _CHUNK):
        cells = ((points[begin : begin + _CHUNK] - low) * (((1 << 21) - 1) / extent)).astype(np.uint64)
        x, y, z = (_spread(cells[:, k]) for k in range(3))
        keys[begin : begin + _CHUNK] = x | (y << np.uint64(1)) | (z << np.uint64(2))
    return np.argsort(keys)


def _spread(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the 21 lowest bits with two zeros between each: a Morton code's part."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


_LEAF = 4  # faces in a leaf
_LEAVES = 200_000  # made at a time
_QUERIES = 20_000  # at a time, which limits the memory
_PAIRS = 1_000_000  # of a query and a face, compared at a time


@dataclass(frozen=True, slots=True)
class NearestPoints:
    """The places on a mesh that are nearest to some points: distance (Q,), place (Q, 3), face (Q,)."""

    distance_m: Array = field(repr=False)
    points_m: Array = field(repr=False)
    faces: IntArray = field(repr=False)


class TriangleTree:
    """The faces of a mesh, in which the nearest place of the surface to any point is found exactly."""

    def __init__(self, surface: Surface) -> None:
        faces, self._vertices = surface.faces, surface.vertices_m
        middles = np.empty((len(faces), 3))
        for block in surface.blocks():
            middles[block] = self._vertices[faces[block]].mean(axis=1)
        self._order = z_order(middles)
        del middles
        self._faces = faces[self._order]
        low, high = (np.empty((-(-len(faces) // _LEAF), 3)) for _ in range(2))
        for begin in range(0, len(low), _LEAVES):
            corners = self._vertices[self._faces[_LEAF * begin : _LEAF * (begin + _LEAVES)]]
            leaves = np.arange(0, len(corners), _LEAF)
            low[begin : begin + _LEAVES] = np.minimum.reduceat(corners.min(axis=1), leaves, axis=0)
            high[begin : begin + _LEAVES] = np.maximum.reduceat(corners.max(axis=1), leaves, axis=0)
        self._levels = [(low, high)]  # from the leaves to the root; two boxes have one parent
        while len(low) > 1:
            pairs = np.arange(0, len(low), 2)
            low, high = np.minimum.reduceat(low, pairs, axis=0), np.maximum.reduceat(high, pairs, axis=0)
            self._levels.append((low, high))

    def nearest(self, queries_m: Array, bounds_m: Array | None = None) -> NearestPoints:
        """Find the point of the surface nearest to each query (Q, 3).

        Args:
            queries_m: (Q, 3) the queries' places.
            bounds_m: (Q,) distances from each query to some place of the surface, such as a sample of it. The
                closer these are to the answer, the faster it is found; None: found by descending the tree.
        """
        out = NearestPoints(
            np.empty(len(queries_m)), np.empty((len(queries_m), 3)), np.empty(len(queries_m), dtype=np.int64)
        )
        for begin in range(0, len(queries_m), _QUERIES):
            part = slice(begin, begin + _QUERIES)
            queries = queries_m[part]
            bounds = self._descended(queries) if bounds_m is None else bounds_m[part]
            query, leaf = self._candidates(queries, bounds * (1 + 1e-9) + 1e-12)
            d, p, f = self._closest(queries, query, leaf)
            out.distance_m[part], out.points_m[part], out.faces[part] = d, p, self._order[f]
        return out

    def _descended(self, queries: Array) -> Array:
        """Return (Q,) distance to a face that is found by always taking the nearer box."""
        at = np.zeros(len(queries), dtype=np.int64)
        for low, high in self._levels[-2::-1]:
            left, right = 2 * at, np.minimum(2 * at + 1, len(low) - 1)
            nearer = _box_distance(queries, low[right], high[right]) < _box_distance(queries, low[left], high[left])
            at = np.where(nearer, right, left)
        return self._closest(queries, np.arange(len(queries)), at)[0]

    def _candidates(self, queries: Array, bounds: Array) -> tuple[IntArray, IntArray]:
        """Return all pairs of a query and a leaf whose box is within the query's bound, sorted by query."""
        query = np.arange(len(queries))
        node = np.zeros(len(queries), dtype=np.int64)
        for low, high in self._levels[-2::-1]:
            query, node = np.repeat(query, 2), np.repeat(2 * node, 2)
            node[1::2] += 1
            there = node < len(low)
            query, node = query[there], node[there]
            near = _box_distance(queries[query], low[node], high[node]) <= bounds[query]
            query, node = query[near], node[near]
        return query, node

    def _closest(self, queries: Array, query: IntArray, leaf: IntArray) -> tuple[Array, Array, IntArray]:
        """Find the face of these leaves that is nearest to each query. Returns distance, nearest point and face."""
        distance = np.full(len(queries), np.inf)
        place, face = np.empty((len(queries), 3)), np.zeros(len(queries), dtype=np.int64)
        step = _PAIRS // _LEAF
        for begin in range(0, len(query), step):
            which = np.repeat(query[begin : begin + step], _LEAF)
            faces = (leaf[begin : begin + step, None] * _LEAF + np.arange(_LEAF)).ravel()
            there = faces < len(self._faces)
            which, faces = which[there], faces[there]
            p = closest_on_triangles(queries[which], self._vertices[self._faces[faces]])
            d = np.linalg.norm(p - queries[which], axis=1)
            best = np.lexsort((d, which))
            best = best[np.flatnonzero(np.diff(which[best], prepend=-1))]
            better = best[d[best] < distance[which[best]]]
            at = which[better]
            distance[at], place[at], face[at] = d[better], p[better], faces[better]
        return distance, place, face


def _box_distance(points: Array, low: Array, high: Array) -> Array:
    """Return (N,) distance from points (N, 3) to boxes with these corners (N, 3)."""
    return np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)


def closest_on_triangles(points: Array, corners: Array) -> Array:
    """Return (N, 3) the place of each triangle (N, 3, 3) that is nearest to its point (N, 3).

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.5, on arrays.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    whole = va + vb + vc
    solid = np.abs(whole) > 0
    scale = 1 / np.where(solid, whole, 1.0)
    v, w = vb * scale, vc * scale
    on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    on_bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)
    t = _ratio(d4 - d3, (d4 - d3) + (d5 - d6))
    v, w = np.where(on_bc, 1 - t, v), np.where(on_bc, t, w)
    v, w = np.where(on_ac, 0.0, v), np.where(on_ac, _ratio(d2, d2 - d6), w)
    v, w = np.where(on_ab, _ratio(d1, d1 - d3), v), np.where(on_ab, 0.0, w)
    at_c, at_b, at_a = (d6 >= 0) & (d5 <= d6), (d3 >= 0) & (d4 <= d3), (d1 <= 0) & (d2 <= 0)
    v, w = np.where(at_c, 0.0, v), np.where(at_c, 1.0, w)
    v, w = np.where(at_b, 1.0, v), np.where(at_b, 0.0, w)
    v, w = np.where(at_a, 0.0, v), np.where(at_a, 0.0, w)
    return np.stack([a[:, k] + v * ab[:, k] + w * ac[:, k] for k in range(3)], axis=1)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ni,ni->n", a, b)


def _ratio(a: Array, b: Array) -> Array:
    return np.clip(a / np.where(b == 0, 1.0, b), 0.0, 1.0)
