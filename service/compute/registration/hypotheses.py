"""Which image sphere is which marker, in one image: all triples the sizes allow, verified against the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.core.geometry import Array, Transform, apply, transform

_MOST_DETECTIONS = 18  # of one image, the best ones: triples grow with the cube
_MOST_REFINED = 60


@dataclass(frozen=True, slots=True)
class Sightings:
    """The detections of one image as geometry: directions, sizes, and positions from the known radius."""

    axes: Array  # (D, 3) unit vectors to the centres: not the ellipses' centres
    half_angles: Array  # (D,)
    positions_m: Array  # (D, 3) in the camera frame, good across the ray, weak along it
    depth_sigma_m: Array  # (D,)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One reading of an image."""

    markers: dict[int, int]  # detection → marker
    T_camera_scan: Transform
    rms_px: float

    @property
    def count(self) -> int:
        """How many detections it explains."""
        return len(self.markers)


def sightings(outlines: Sequence[SphereOutline], radius_m: float, camera: CameraModel) -> Sightings:
    """Geometry of the outlines of one image."""
    if not outlines:
        return Sightings(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    axes = np.array([o.cone.axis for o in outlines])
    half = np.array([o.cone.half_angle_rad for o in outlines])
    distance = radius_m / np.sin(half)
    # Half a pixel of the radius covers the systematic error of an outline, more where only a part is seen.
    sigma = 0.5 / camera.fx / np.array([max(o.coverage, 0.2) for o in outlines])
    return Sightings(axes, half, axes * distance[:, None], distance * sigma / half)


def match(
    seen: Sightings, centres_camera_m: Array, radius_m: float, gate: float, size_gate: float
) -> list[tuple[int, int, float]]:
    """Mutually nearest (detection, marker, angle): angle below `gate` marker radii, size within `size_gate`."""
    if len(seen.axes) == 0:
        return []
    distance = np.linalg.norm(centres_camera_m, axis=1)
    front = (centres_camera_m[:, 2] > 0) & (distance > 2 * radius_m)
    safe = np.maximum(distance, 2 * radius_m)
    half = np.arcsin(radius_m / safe)
    angle = np.arccos(np.clip(seen.axes @ (centres_camera_m / safe[:, None]).T, -1, 1))
    ratio = seen.half_angles[:, None] / half
    angle[(angle > gate * half) | (np.abs(ratio - 1) > size_gate) | ~front[None, :]] = np.inf
    nearest = np.argmin(angle, axis=1)
    back = np.argmin(angle, axis=0)
    return [
        (d, int(m), float(angle[d, m]))
        for d, m in enumerate(nearest)
        if np.isfinite(angle[d, m]) and int(back[m]) == d
    ]


def image_hypotheses(
    outlines: Sequence[SphereOutline], centres_scan_m: Array, radius_m: float, camera: CameraModel
) -> list[Hypothesis]:
    """Readings of an image that explain at least four detections, the best first; distinct ones only.

    Triples of detections are paired with all ordered triples of markers whose mutual distances the known radius
    allows (size gives depth to about a hundredth), each gives a pose, and a fourth and every further detection must
    agree; survivors are solved by PnP on the directions of the sphere centres and verified again, strictly.
    """
    seen = sightings(outlines, radius_m, camera)
    D = min(len(seen.axes), _MOST_DETECTIONS)
    if D < 4 or len(centres_scan_m) < 4:
        return []
    model, image = _triples(seen, D, centres_scan_m)
    if len(model) == 0:
        return []
    R, t = _kabsch(centres_scan_m[model], seen.positions_m[image])
    counts, error = _support(seen, R, t, centres_scan_m, radius_m)
    order = np.lexsort((error, -counts))
    results: dict[frozenset[tuple[int, int]], Hypothesis] = {}
    tried: set[frozenset[tuple[int, int]]] = set()
    for h in order[:4000]:
        if counts[h] < 4 or len(tried) >= _MOST_REFINED:
            break
        pairs = match(seen, centres_scan_m @ R[h].T + t[h], radius_m, 0.8, 0.12)
        key = frozenset((d, m) for d, m, _ in pairs)
        if len(pairs) < 4 or key in tried:
            continue
        tried.add(key)
        refined = _refine(seen, {d: m for d, m, _ in pairs}, centres_scan_m, radius_m, camera)
        if refined is not None:
            results.setdefault(frozenset(refined.markers.items()), refined)
    found = sorted(results.values(), key=lambda r: (-r.count, r.rms_px))
    # A reading contained in a better one adds nothing.
    kept: list[Hypothesis] = []
    for r in found:
        if not any(set(r.markers.items()) <= set(k.markers.items()) for k in kept):
            kept.append(r)
    return kept


def _triples(seen: Sightings, D: int, centres: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    model_distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    images: list[NDArray[np.int64]] = []
    models: list[NDArray[np.int64]] = []
    fits: dict[tuple[int, int], NDArray[np.bool_]] = {}
    for i, j in combinations(range(D), 2):
        between = float(np.linalg.norm(seen.positions_m[i] - seen.positions_m[j]))
        tolerance = 0.002 + 2.5 * float(np.hypot(seen.depth_sigma_m[i], seen.depth_sigma_m[j]))
        fits[i, j] = (np.abs(model_distance - between) < tolerance) & (model_distance > 0)
    for i, j, k in combinations(range(D), 3):
        ab, ac, bc = fits[i, j], fits[i, k], fits[j, k]
        possible = np.argwhere(ab[:, :, None] & ac[:, None, :] & bc[None, :, :])
        if len(possible):
            models.append(possible)
            images.append(np.tile([i, j, k], (len(possible), 1)))
    if not models:
        return np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3), dtype=np.int64)
    return np.concatenate(models), np.concatenate(images)


def _kabsch(model: Array, image: Array) -> tuple[Array, Array]:
    """Rotations (K, 3, 3) and translations (K, 3) with image = R model + t, for batches (K, 3, 3) of three points."""
    cm, ci = model.mean(axis=1), image.mean(axis=1)
    H = np.einsum("kni,knj->kij", image - ci[:, None], model - cm[:, None])
    U, _, Vt = np.linalg.svd(H)
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= sign[:, None]
    R = U @ Vt
    return R, ci - np.einsum("kij,kj->ki", R, cm)


def _support(seen: Sightings, R: Array, t: Array, centres: Array, radius_m: float) -> tuple[NDArray[np.int64], Array]:
    """Detections explained (K,) by each pose, loosely, and their mean angle in radii."""
    counts = np.zeros(len(R), dtype=np.int64)
    error = np.zeros(len(R))
    for start in range(0, len(R), 2000):
        part = slice(start, start + 2000)
        c = np.einsum("kij,mj->kmi", R[part], centres) + t[part, None]
        distance = np.maximum(np.linalg.norm(c, axis=2), 2 * radius_m)
        cosine = np.einsum("dj,kmj->kdm", seen.axes, c / distance[..., None])
        half = np.arcsin(radius_m / distance)
        angle = np.arccos(np.clip(cosine, -1, 1)) / half[:, None, :]
        ratio = seen.half_angles[None, :, None] / half[:, None, :]
        angle[(angle > 0.8) | (np.abs(ratio - 1) > 0.12)] = np.inf
        nearest = angle.min(axis=2)
        ok = np.isfinite(nearest)
        counts[part] = ok.sum(axis=1)
        error[part] = np.where(ok, nearest, 0).sum(axis=1) / np.maximum(ok.sum(axis=1), 1)
    return counts, error


def _refine(
    seen: Sightings, markers: dict[int, int], centres: Array, radius_m: float, camera: CameraModel
) -> Hypothesis | None:
    f = camera.fx
    for _ in range(4):
        if len(markers) < 4:
            return None
        T = _pnp(seen.axes[list(markers)], centres[list(markers.values())])
        if T is None:
            return None
        pairs = match(seen, apply(T, centres), radius_m, 0.08, 0.08)
        # The worst of a set with one intruder spoils all: drop it and try again with the rest.
        if len(pairs) < len(markers):
            c = apply(T, centres[list(markers.values())])
            c /= np.linalg.norm(c, axis=1, keepdims=True)
            angle = np.arccos(np.clip(np.sum(c * seen.axes[list(markers)], axis=1), -1, 1))
            worst = list(markers)[int(np.argmax(angle))]
            kept = {d: m for d, m, _ in pairs}
            markers = kept if len(kept) >= 4 else {d: m for d, m in markers.items() if d != worst}
            continue
        new = {d: m for d, m, _ in pairs}
        if new == markers:
            angles = np.array([a for _, _, a in pairs])
            return Hypothesis(markers, T, float(np.sqrt(np.mean(angles**2))) * f)
        markers = new
    return None


def _pnp(axes: Array, points: Array) -> Transform | None:
    """T_camera_scan from directions (N, 3) to points (N, 3), N ≥ 4: SQPnP, then Levenberg–Marquardt."""
    if np.any(axes[:, 2] < 0.2):
        return None
    pixels = np.ascontiguousarray(axes[:, :2] / axes[:, 2:])
    eye = np.eye(3)
    ok, rvec, tvec = cv2.solvePnP(points, pixels, eye, None, flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        return None
    rvec, tvec = cv2.solvePnPRefineLM(points, pixels, eye, None, rvec, tvec)
    T = transform(cv2.Rodrigues(rvec)[0].astype(np.float64), np.asarray(tvec, dtype=np.float64).reshape(3))
    return T if np.all(np.isfinite(T)) and np.all(apply(T, points)[:, 2] > 0) else None
