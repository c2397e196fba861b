"""Scan-like meshes and point clouds of spheres with clutter, holes and correlated noise."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray

from service.core.geometry import Array

IntArray = NDArray[np.int64]
RADIUS_M = 0.015


@dataclass
class MeshBuilder:
    """Pieces of surface that are merged into one mesh."""

    pieces: list[tuple[Array, IntArray]] = field(default_factory=list)

    def add(self, vertices: Array, faces: IntArray) -> None:
        """Add a piece with its own vertex numbering."""
        self.pieces.append((np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)))

    def build(self) -> tuple[Array, IntArray]:
        """Vertices (V, 3) and faces (F, 3) of all pieces."""
        offsets = np.cumsum([0, *(len(v) for v, _ in self.pieces)])
        return (
            np.concatenate([v for v, _ in self.pieces]),
            np.concatenate([f + o for (_, f), o in zip(self.pieces, offsets, strict=False)]),
        )


def shared_noise(
    points: Array, rng: np.random.Generator, white_m: float, shared_m: float = 0.0, length_m: float = 4e-3
) -> Array:
    """Heights (N,): white noise, plus a smooth part with a correlation length (random plane waves)."""
    noise = rng.normal(0.0, white_m, len(points))
    if shared_m > 0:
        waves = rng.normal(0.0, 1 / length_m, (200, 3))
        phase = rng.uniform(0, 2 * np.pi, 200)
        noise = noise + shared_m * np.sqrt(2 / 200) * np.cos(points @ waves.T + phase).sum(axis=1)
    return noise


def cap(
    centre: Array,
    half_angle_rad: float,
    rng: np.random.Generator,
    *,
    level: int = 4,
    white_m: float = 5e-5,
    shared_m: float = 0.0,
    length_m: float = 4e-3,
    radius_m: float = RADIUS_M,
    pinholes: float = 0.03,
) -> tuple[Array, IntArray]:
    """A cap of a sphere in a random direction of the upper half, with holes and noise along the normal."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    axis = rng.normal(size=3)
    axis[2] = abs(axis[2]) + 0.5
    axis /= np.linalg.norm(axis)
    unit = np.asarray(ball.vertices) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    faces = np.asarray(ball.faces)
    seen = (unit[faces].mean(axis=1) @ axis > np.cos(half_angle_rad)) & (rng.random(len(faces)) > pinholes)
    faces = faces[seen]
    used, index = np.unique(faces, return_inverse=True)
    faces = index.reshape(-1, 3)
    points = radius_m * unit[used]
    height = shared_noise(points + centre, rng, white_m, shared_m, length_m)
    points = points * (1 + height / radius_m)[:, None] + centre
    outward = np.einsum(
        "fi,fi->f",
        np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]),
        points[faces].mean(axis=1) - centre,
    )
    if np.median(outward) < 0:  # the random rotation contains a reflection, which inverts the faces
        faces = faces[:, ::-1]
    return points, faces


def clutter(rng: np.random.Generator, noise_m: float) -> MeshBuilder:
    """Shapes of similar curvature: a cylinder and a torus, other spheres, ellipsoids, a plane."""
    shapes: list[trimesh.Trimesh] = [
        trimesh.creation.cylinder(radius=RADIUS_M, segment=[[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]], sections=96),
        trimesh.creation.torus(0.03, RADIUS_M, major_sections=96, minor_sections=64),
        trimesh.creation.icosphere(subdivisions=4, radius=0.0125),
        trimesh.creation.icosphere(subdivisions=4, radius=0.018),
    ]
    for factors in ((1.0, 1.0, 1.3), (1.0, 1.15, 0.85), (0.8, 0.8, 1.2)):
        ellipsoid = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_M)
        ellipsoid.apply_scale(factors)
        shapes.append(ellipsoid)
    built = MeshBuilder()
    for number, shape in enumerate(shapes):
        mesh = shape.copy()
        for _ in range(2 if len(mesh.vertices) < 1000 else 1):
            mesh = mesh.subdivide() if len(mesh.vertices) < 3000 else mesh
        place = np.array([-0.3 + 0.1 * number, 0.25, 0.05]) + (np.array([0.0, 0.08, 0.0]) if number < 2 else 0.0)
        vertices = np.asarray(mesh.vertices) + place
        built.add(vertices + rng.normal(0, noise_m, vertices.shape), np.asarray(mesh.faces))
    x = np.linspace(-0.4, 0.4, 160)
    X, Y = np.meshgrid(x, x)
    plane = np.stack([X.ravel(), Y.ravel(), np.zeros(X.size)], axis=1)
    i = np.arange(X.size).reshape(X.shape)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    built.add(
        plane + rng.normal(0, noise_m, plane.shape),
        np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]),
    )
    return built


def scattered_centres(rng: np.random.Generator, count: int) -> Array:
    """Centres (count, 3) of spheres that touch neither one another nor the clutter."""
    centres: list[Array] = []
    while len(centres) < count:
        centre = rng.uniform([-0.3, -0.25, 0.05], [0.3, 0.1, 0.12])
        if all(np.linalg.norm(centre - other) > 0.06 for other in centres) and not (
            abs(centre[1]) < 0.05 and abs(centre[0]) < 0.13
        ):
            centres.append(centre)
    return np.array(centres)
