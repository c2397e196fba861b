"""Light at the vertices of the scene: soft shadow of a surgical lamp, and how much of the room each vertex sees."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from simulators.geometry import Array, Array32, Ints

LAMP_RADIUS_M = 0.13
LAMP_SAMPLES = 24
ROOM_SAMPLES = 28


class Caster:
    """Rays against a fixed triangle mesh."""

    def __init__(self, vertices: Array, faces: Ints) -> None:
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, vertices.astype(np.float32), faces.astype(np.int32))

    def blocked(self, origins: Array32, directions: Array32) -> Array32:
        """1.0 where a ray (N, 3) meets something within the length of its direction, else 0.0."""
        # embreex knows no segments: cast and compare the distance with the direction's length, which is 1.
        hit = self._scene.run(origins, directions, query="INTERSECT", output=True)
        return ((hit["primID"] >= 0) & (hit["tfar"] < 1.0)).astype(np.float32)

    def first(self, origins: Array32, directions: Array32) -> tuple[Ints, Array32, Array32, Array32]:
        """Face (-1 for none), distance in lengths of the direction, and barycentric u, v of the first hit (N,)."""
        hit = self._scene.run(origins, directions, query="INTERSECT", output=True)
        return hit["primID"].astype(np.int64), hit["tfar"], hit["u"], hit["v"]


def disk(samples: int) -> Array:
    """Evenly spread points (samples, 2) in the unit disk (Vogel's spiral)."""
    k = np.arange(samples)
    radius, angle = np.sqrt((k + 0.5) / samples), k * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def vertex_light(caster: Caster, vertices: Array, normals: Array, lamp_m: Array) -> Array32:
    """(V, 2): lamp (visibility × cosine × distance law, 1 in the middle of the board) and room (openness, 0..1)."""
    start = (vertices + 4e-4 * normals).astype(np.float32)
    to_lamp = lamp_m - vertices
    distance = np.linalg.norm(to_lamp, axis=1)
    cosine = np.maximum(0.0, np.sum(to_lamp * normals, axis=1) / distance)
    lit = np.zeros(len(vertices), dtype=np.float32)
    for dx, dy in LAMP_RADIUS_M * disk(LAMP_SAMPLES):
        lit += 1.0 - caster.blocked(start, (lamp_m + np.array([dx, dy, 0.0]) - vertices).astype(np.float32))
    reference = float(np.linalg.norm(lamp_m))
    lamp = lit / LAMP_SAMPLES * cosine * (reference / distance) ** 2 * reference / lamp_m[2]
    rng = np.random.default_rng(0)
    room = np.zeros(len(vertices), dtype=np.float32)
    total = np.zeros(len(vertices), dtype=np.float32)
    for x, y in disk(ROOM_SAMPLES):
        up = np.sqrt(max(0.02, 1.0 - x * x - y * y))
        turn = rng.uniform(0.0, 2 * np.pi)
        direction = np.array([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), up])
        weight = np.maximum(0.0, normals @ direction).astype(np.float32)
        # Reach of the occlusion: 0.25 m.
        towards = np.broadcast_to((0.25 * direction).astype(np.float32), start.shape)
        room += weight * (1.0 - caster.blocked(start, np.ascontiguousarray(towards)))
        total += 1.0
    return np.stack([lamp, room / total * 1.4], axis=1).astype(np.float32)
