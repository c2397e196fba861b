"""The solids of the scene: closed triangle meshes with texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array, Ints


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of the scene, in world metres: vertices (V, 3), outward faces (F, 3), texture coordinates (V, 2)."""

    name: str
    material: str
    vertices_m: Array
    faces: Ints
    uv: Array


def join_parts(name: str, material: str, parts: list[Part]) -> Part:
    """Merge several parts of the same material into one."""
    offsets = np.cumsum([0, *(len(part.vertices_m) for part in parts[:-1])])
    return Part(
        name,
        material,
        np.concatenate([part.vertices_m for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
        np.concatenate([part.uv for part in parts]),
    )


def grid_faces(rows: int, columns: int) -> Ints:
    """Return the faces (2 (rows-1) (columns-1), 3) of a row-major vertex grid, normals along d/drow × d/dcolumn."""
    i = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def vertex_normals(vertices: Array, faces: Ints) -> Array:
    """Return area-weighted unit normals (V, 3)."""
    p = vertices[faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    out = np.stack([np.bincount(faces.ravel(), np.repeat(n[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)


def cylinder(
    start_m: Array, end_m: Array, radius_m: float, sides: int, rings: int, v_range: tuple[float, float]
) -> Part:
    """Build a capped cylinder; texture u runs around it, v along it within `v_range`."""
    axis = end_m - start_m
    z = axis / np.linalg.norm(axis)
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    angle = np.linspace(0.0, 2 * np.pi, sides + 1)
    t = np.linspace(0.0, 1.0, rings + 1)
    circle = radius_m * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y)
    wall = start_m + t[None, :, None] * axis + circle[:, None, :]
    # The seam repeats vertices for the texture; bitwise equality keeps the solid closed after merging.
    wall[-1] = wall[0]
    uv = np.stack(
        np.broadcast_arrays(angle[:, None] / (2 * np.pi), v_range[0] + t * (v_range[1] - v_range[0])), axis=-1
    )
    n = (sides + 1) * (rings + 1)
    first = np.arange(sides, dtype=np.int64) * (rings + 1)
    bottom = np.stack([np.full(sides, n), first + rings + 1, first], axis=1)
    top = np.stack([np.full(sides, n + 1), first + rings, first + 2 * rings + 1], axis=1)
    return Part(
        "cylinder",
        "",
        np.concatenate([wall.reshape(-1, 3), [start_m, end_m]]),
        np.concatenate([grid_faces(sides + 1, rings + 1), bottom, top]),
        np.concatenate([uv.reshape(-1, 2), [[0.5, v_range[0]], [0.5, v_range[1]]]]),
    )


def sphere_mesh(centre_m: Array, radius_m: float, subdivisions: int = 4) -> Part:
    """Build a sphere by subdividing an octahedron: 8 · 4^n faces, with all vertices on the sphere."""
    v = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    f = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int64
    )
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = v[unique].mean(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = index.reshape(3, -1) + len(v)
        v = np.concatenate([v, middle])
        a, b, c = f.T
        f = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return Part("sphere", "marker", centre_m + radius_m * v, f, np.zeros((len(v), 2)))


def box(low_m: Array, high_m: Array, cell_m: float) -> Part:
    """Build a closed box whose top is a grid of about `cell_m`, because light is stored at vertices; uv is (x, y)."""
    nx, ny = (max(1, round(float(s) / cell_m)) for s in (high_m - low_m)[:2])
    x, y = np.linspace(low_m[0], high_m[0], nx + 1), np.linspace(low_m[1], high_m[1], ny + 1)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    top = np.stack([gx, gy, np.full_like(gx, high_m[2])], axis=-1).reshape(-1, 3)
    uv = (top[:, :2] - low_m[:2]) / (high_m - low_m)[:2]
    index = np.arange((nx + 1) * (ny + 1), dtype=np.int64).reshape(nx + 1, ny + 1)
    # Go around the rim with the interior on the left: +x at low y, +y at high x, -x, -y.
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    n, m = len(top), len(rim)
    upper, below = top[rim].copy(), top[rim].copy()
    below[:, 2] = low_m[2]
    u, w = np.arange(m) + n, np.arange(m) + n + m
    un, wn = np.roll(u, -1), np.roll(w, -1)
    # The side walls have their own vertices (at the rim's positions), so that edges stay sharp.
    walls = np.concatenate([np.stack([w, wn, un], axis=1), np.stack([w, un, u], axis=1)])
    centre = np.array([[*((low_m + high_m) / 2)[:2], low_m[2]]])
    floor = np.stack([np.full(m, n + 2 * m), np.roll(w, -1), w], axis=1)
    return Part(
        "box",
        "",
        np.concatenate([top, upper, below, centre]),
        np.concatenate([grid_faces(nx + 1, ny + 1), walls, floor]),
        np.concatenate([uv, uv[rim] * 0.98 + 0.01, uv[rim] * 0.98 + 0.01, [[0.5, 0.5]]]),
    )
