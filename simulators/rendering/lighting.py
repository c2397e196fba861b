"""Light at the scene's vertices: the soft shadow of a surgical lamp, and the share of the room each vertex sees."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from simulators.geometry import Array, Array32, Bools, Ints

THREADS = min(4, os.cpu_count() or 1)
LAMP_RADIUS_M = 0.13
LAMP_SAMPLES = 24
ROOM_SAMPLES = 28


class Caster:
    """Casts rays against a fixed triangle mesh."""

    def __init__(self, vertices: Array, faces: Ints) -> None:
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, vertices.astype(np.float32), faces.astype(np.int32))
        ray = np.array([[0, 0, 1]], dtype=np.float32)
        self._scene.run(ray, ray)  # builds the tree, which several threads must not do at once

    def blocked(self, origins: Array32, directions: Array32) -> Bools:
        """Return whether each ray (N, 3) hits something within the length of its direction."""
        # embreex cannot cast segments: compare the hit distance with the direction's length, which is 1.
        hit = self._scene.run(origins, directions, query="INTERSECT", output=True)
        return (hit["primID"] >= 0) & (hit["tfar"] < 1.0)

    def first(self, origins: Array32, directions: Array32) -> tuple[Ints, Array32, Array32, Array32]:
        """Face (-1: none), distance in lengths of the direction, and barycentric u, v of each first hit (N,)."""
        hit = self._scene.run(origins, directions, query="INTERSECT", output=True)
        return hit["primID"].astype(np.int64), hit["tfar"], hit["u"], hit["v"]


def disk(samples: int) -> Array:
    """Return evenly distributed points (samples, 2) in the unit disk (Vogel's spiral)."""
    k = np.arange(samples)
    radius, angle = np.sqrt((k + 0.5) / samples), k * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def blocked_rays(caster: Caster, vertices: Array, normals: Array, lamp_m: Array) -> Bools:
    """Say whether something occludes each sample of lamp and room, per vertex: (LAMP_SAMPLES + ROOM_SAMPLES, V)."""
    start = (vertices + 4e-4 * normals).astype(np.float32)
    towards_lamp = (
        (lamp_m + np.array([dx, dy, 0.0]) - vertices).astype(np.float32)
        for dx, dy in LAMP_RADIUS_M * disk(LAMP_SAMPLES)
    )
    # Ambient occlusion reaches 0.25 m.
    towards_room = (
        np.ascontiguousarray(np.broadcast_to((0.25 * direction).astype(np.float32), start.shape))
        for direction in _room()
    )
    with ThreadPoolExecutor(THREADS) as pool:  # embree casts rays without Python's lock
        return np.stack(list(pool.map(lambda rays: caster.blocked(start, rays), chain(towards_lamp, towards_room))))


def vertex_light(blocked: Bools, vertices: Array, normals: Array, lamp_m: Array) -> Array32:
    """Return (V, 2): lamp (visibility × cosine × distance law, 1 at the board's centre) and room (openness, 0…1)."""
    to_lamp = lamp_m - vertices
    distance = np.linalg.norm(to_lamp, axis=1)
    cosine = np.maximum(0.0, np.sum(to_lamp * normals, axis=1) / distance)
    lit = np.count_nonzero(~blocked[:LAMP_SAMPLES], axis=0)
    reference = float(np.linalg.norm(lamp_m))
    lamp = lit / LAMP_SAMPLES * cosine * (reference / distance) ** 2 * reference / lamp_m[2]
    room = np.zeros(len(vertices), dtype=np.float32)
    for direction, hidden in zip(_room(), blocked[LAMP_SAMPLES:], strict=True):
        weight = np.maximum(0.0, normals @ direction).astype(np.float32)
        room += weight * ~hidden
    return np.stack([lamp, room / ROOM_SAMPLES * 1.4], axis=1).astype(np.float32)


def _room() -> list[Array]:
    """Unit directions (3,) over the upper hemisphere."""
    rng = np.random.default_rng(0)
    directions: list[Array] = []
    for x, y in disk(ROOM_SAMPLES):
        up = np.sqrt(max(0.02, 1.0 - x * x - y * y))
        turn = rng.uniform(0.0, 2 * np.pi)
        directions.append(np.array([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), up]))
    return directions
