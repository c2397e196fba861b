"""A specimen with a wound as a CT and a scanner see it, and the spheres around it."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from service.compute.surfaces.surface import IntArray, Surface
from service.core.geometry import Array, transform

HALF_M = (0.030, 0.025)
WOUND_M = 0.010  # half width of the hollow that the scanner does not see into
BIAS_M = 1.0e-4  # of the CT's surface, upwards
RADIUS_M = 0.006
CENTRES_M = np.array(
    [[0.06, 0.0, 0.02], [-0.055, 0.03, 0.035], [-0.05, -0.045, 0.015], [0.03, 0.055, 0.05], [0.025, -0.06, 0.03]]
)
T_WORLD_CT = transform(Rotation.from_rotvec([0.4, -0.3, 2.0]), np.array([0.2, -0.1, 0.05]))


def height(x: Array, y: Array) -> Array:
    """The true surface: gentle hills, and a hollow 12 mm deep."""
    hills = 0.0015 * np.sin(x / 0.008) * np.cos(y / 0.007)
    return 0.03 + hills - 0.012 * np.exp(-(((x**2 + y**2) / WOUND_M**2) ** 2))


def grid(spacing_m: float) -> tuple[Array, Array, IntArray]:
    x, y = np.meshgrid(*(np.linspace(-half, half, round(2 * half / spacing_m) + 1) for half in HALF_M), indexing="ij")
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return x.ravel(), y.ravel(), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def ct_mesh(noise_m: float = 0.0) -> Surface:
    """A closed block whose top is the surface, everywhere too high by BIAS_M."""
    x, y, faces = grid(5e-4)
    z = height(x, y) + BIAS_M + np.random.default_rng(1).normal(0, noise_m, len(x))
    n = len(x)
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    keys, counts = np.unique(ends[:, 0] * n + ends[:, 1], return_counts=True)
    rim = {tuple(sorted((int(k) // n, int(k) % n))) for k in keys[counts == 1]}
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    side = np.array([e for e in directed.tolist() if tuple(sorted(e)) in rim])
    p, q = side.T
    walls = np.concatenate([np.stack([p, p + n, q], axis=1), np.stack([q, p + n, q + n], axis=1)])
    vertices = np.concatenate([np.stack([x, y, z], axis=1), np.stack([x, y, np.zeros(n)], axis=1)])
    return Surface(vertices, np.concatenate([faces, faces[:, ::-1] + n, walls]))


def scan_mesh(noise_m: float = 0.0) -> Surface:
    """The surface without the hollow, in a grid of its own."""
    x, y, faces = grid(4e-4)
    seen = np.hypot(x, y) > WOUND_M
    z = height(x, y) + np.random.default_rng(2).normal(0, noise_m, len(x))
    return Surface(np.stack([x, y, z], axis=1), faces[seen[faces].all(axis=1)])


def with_spheres(mesh: Surface, centres_m: Array) -> Surface:
    """The mesh and a ball of RADIUS_M at each centre (N, 3)."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS_M)
    vertices, faces = [mesh.vertices_m], [mesh.faces]
    for centre in centres_m:
        faces.append(np.array(ball.faces, dtype=np.int64) + sum(len(v) for v in vertices))
        vertices.append(np.array(ball.vertices) + centre)
    return Surface(np.concatenate(vertices), np.concatenate(faces))
