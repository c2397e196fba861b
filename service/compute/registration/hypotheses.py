"""Identifies markers in one image: by triples that the sizes allow, or the nearest sphere where the pose is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton
from service.compute.markers.cones import ObservedCones
from service.compute.markers.records import SphereOutline
from service.core.geometry import Array, Transform, apply, skew, transform

_FLOOR_RAD = 1.2e-4  # error from sphere list and lens, added to an outline's own: 0.1 mm at a metre and less


@dataclass(frozen=True, slots=True)
class MatchGate:
    """Largest deviation of an outline from the predicted sphere that it is matched to."""

    place: float  # in units of the sphere's apparent radius
    size: float  # relative


ROBOT_GATE = MatchGate(0.5, 0.12)  # wide enough for a robot that is off by millimetres
CONTROL_GATE = MatchGate(0.5, 0.15)  # if a sphere is farther from its prediction, the registration is wrong


@dataclass(frozen=True, slots=True)
class Sightings:
    """The geometry of one image's detections: cones, and positions from the known radius."""

    cones: ObservedCones  # (D,)
    positions_m: Array  # (D, 3) in the camera frame, precise across the ray, imprecise along it
    depth_sigma_m: Array  # (D,)
    sigma_rad: Array  # (D, 3) of tilt, tilt and half angle


def sightings(outlines: Sequence[SphereOutline], radius_m: float, camera: CameraModel) -> Sightings:
    """Return the geometry of one image's outlines."""
    cones = ObservedCones.of(o.cone for o in outlines)
    distance = radius_m / np.sin(cones.half_angles)
    # Half a pixel of the radius covers an outline's systematic error; more if only a part is visible.
    sigma = 0.5 / camera.fx / np.array([max(o.coverage, 0.2) for o in outlines])
    own = np.array([np.diag(o.cone_covariance) for o in outlines], dtype=np.float64).reshape(-1, 3)
    return Sightings(
        cones, cones.axes * distance[:, None], distance * sigma / cones.half_angles, np.sqrt(own + _FLOOR_RAD**2)
    )


def match(seen: Sightings, centres_camera_m: Array, radius_m: float, gate: MatchGate) -> list[tuple[int, int, float]]:
    """Pair detections with markers that are mutually nearest and within the gate.

    The markers' centres (M, 3) are in the camera frame. Returns (detection, marker, angle in radians) of each pair.
    """
    if len(seen.cones) == 0:
        return []
    distance = np.linalg.norm(centres_camera_m, axis=1)
    front = (centres_camera_m[:, 2] > 0) & (distance > 2 * radius_m)
    safe = np.maximum(distance, 2 * radius_m)
    half = np.arcsin(radius_m / safe)
    angle = np.arccos(np.clip(seen.cones.axes @ (centres_camera_m / safe[:, None]).T, -1, 1))
    ratio = seen.cones.half_angles[:, None] / half
    angle[(angle > gate.place * half) | (np.abs(ratio - 1) > gate.size) | ~front[None, :]] = np.inf
    nearest = np.argmin(angle, axis=1)
    back = np.argmin(angle, axis=0)
    return [
        (d, int(m), float(angle[d, m]))
        for d, m in enumerate(nearest)
        if np.isfinite(angle[d, m]) and int(back[m]) == d
    ]


def paired(
    outlines: Sequence[SphereOutline],
    T_camera_scan: Transform,
    spheres_m: Array,
    radius_m: float,
    camera: CameraModel,
    gate: MatchGate = ROBOT_GATE,
) -> dict[int, int]:
    """Return the outline → sphere (M, 3) of the scan frame, matched by predicted directions and sizes."""
    pairs = match(sightings(outlines, radius_m, camera), apply(T_camera_scan, spheres_m), radius_m, gate)
    return {d: m for d, m, _ in pairs}


_MOST_DETECTIONS = 18  # per image, the best ones: the number of triples grows with the cube
_MOST_REFINED = 150
_CLOSE = MatchGate(0.1, 0.03)  # of a pose solved from several outlines
_CHUNK = 4000  # triples refined at a time
_TRIPLE_CHI2 = 30.0  # 3 degrees of freedom
_OUTLINE_CHI2 = 30.0  # 3 degrees of freedom
_EVIDENCE = 14.0  # log likelihood ratio of a marker to a false detection at an expected place; a low estimate
_MOST_KEPT = 512  # images whose hypotheses are cached
_MARGIN = 9.0  # log odds at which an assignment counts as unique


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One possible assignment of markers in an image."""

    markers: dict[int, int]  # detection → marker
    T_camera_scan: Transform
    rms_px: float
    score: float = 0.0  # log odds against a chance match

    @property
    def count(self) -> int:
        """Number of detections that it explains."""
        return len(self.markers)


def image_hypotheses(
    outlines: Sequence[SphereOutline], centres_scan_m: Array, radius_m: float, camera: CameraModel
) -> list[Hypothesis]:
    """Find distinct assignments that explain at least four detections of an image, the best first.

    Triples of detections are paired with all ordered triples of markers whose mutual distances fit (the known radius
    and the apparent size give depth to about one per cent). Each pair gives a pose from the nine parameters of its
    three outlines. Poses that fit must predict a fourth detection, and all further ones. The survivors are solved
    from all their outlines and judged by their residuals in standard deviations.

    The answer does not depend on camera poses, so it is cached for the registrations of the same images with others.
    """
    if len(outlines) < 4 or len(centres_scan_m) < 4:
        return []
    seen = sightings(outlines, radius_m, camera)
    return list(_answer(_Question(seen, np.asarray(centres_scan_m), radius_m, camera.fx)))


class _Question:
    """The inputs that determine the hypotheses of an image; equal if all its numbers are."""

    def __init__(self, seen: Sightings, centres: Array, radius_m: float, focal_px: float) -> None:
        self.seen, self.centres, self.radius_m, self.focal_px = seen, centres, radius_m, focal_px
        cones = (seen.cones.axes, seen.cones.half_angles, seen.depth_sigma_m, seen.sigma_rad)
        self._numbers = (radius_m, focal_px, *(array.tobytes() for array in (*cones, centres)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Question) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)


@lru_cache(maxsize=_MOST_KEPT)
def _answer(question: _Question) -> tuple[Hypothesis, ...]:
    seen, centres, radius_m = question.seen, question.centres, question.radius_m
    model, image = _triples(seen, min(len(seen.cones), _MOST_DETECTIONS), centres)
    if len(model) == 0:
        return ()
    R, t = _fitting(seen, model, image, centres, radius_m)
    counts, error = _support(seen, R, t, centres, radius_m)
    order = np.lexsort((error, -counts))
    results: dict[frozenset[tuple[int, int]], Hypothesis] = {}
    tried: set[frozenset[tuple[int, int]]] = set()
    for h in order[:4000]:
        if counts[h] < 4 or len(tried) >= _MOST_REFINED:
            break
        pairs = match(seen, centres @ R[h].T + t[h], radius_m, _LOOSE)
        key = frozenset((d, m) for d, m, _ in pairs)
        if len(pairs) < 4 or key in tried:
            continue
        tried.add(key)
        refined = _refine(seen, {d: m for d, m, _ in pairs}, R[h], t[h], centres, radius_m, question.focal_px)
        if refined is not None:
            results.setdefault(frozenset(refined.markers.items()), refined)
    found = sorted(results.values(), key=lambda r: -r.score)
    # An assignment contained in a better one adds nothing.
    kept: list[Hypothesis] = []
    for r in found:
        if not any(set(r.markers.items()) <= set(k.markers.items()) for k in kept):
            kept.append(r)
    return tuple(kept)


def rivals(readings: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Select, from assignments sorted best first, those that contradict the best and are nearly as likely."""
    if not readings:
        return []
    best = readings[0]
    return [r for r in readings[1:] if best.score - r.score < _MARGIN and _contradict(best, r)]


def _contradict(a: Hypothesis, b: Hypothesis) -> bool:
    shared = a.markers.keys() & b.markers.keys()
    return any(a.markers[d] != b.markers[d] for d in shared) or not shared


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
    """Return rotations (K, 3, 3) and translations (K, 3) with image = R model + t, for three points each."""
    cm, ci = model.mean(axis=1), image.mean(axis=1)
    H = np.einsum("kni,knj->kij", image - ci[:, None], model - cm[:, None])
    U, _, Vt = np.linalg.svd(H)
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= sign[:, None]
    R = U @ Vt
    return R, ci - np.einsum("kij,kj->ki", R, cm)


_LOOSE = MatchGate(0.4, 0.06)  # of a triple's pose


def _fitting(
    seen: Sightings, model: NDArray[np.int64], image: NDArray[np.int64], centres: Array, radius_m: float
) -> tuple[Array, Array]:
    """Return poses (K, 3, 3), (K, 3) of the triples whose nine parameters fit one pose."""
    rotations: list[Array] = []
    places: list[Array] = []
    for start in range(0, len(model), _CHUNK):
        points, pick = centres[model[start : start + _CHUNK]], image[start : start + _CHUNK]
        start_R, start_t = _kabsch(points, seen.positions_m[pick])
        R, t, chi2 = _pose_steps(seen, pick, points, start_R, start_t, radius_m, 3)
        good = chi2 < _TRIPLE_CHI2
        rotations.append(R[good])
        places.append(t[good])
    return np.concatenate(rotations), np.concatenate(places)


def _pose_steps(
    seen: Sightings, pick: NDArray[np.int64], points: Array, rotation: Array, t: Array, radius_m: float, steps: int
) -> tuple[Array, Array, Array]:
    """Return a number of Gauss–Newton steps for K poses at a time: rotations, translations and chi² (K,).

    Each pose explains the cones of detections `pick` (K, k) by spheres at `points` (K, k, 3).
    """
    K, k = pick.shape
    cones, sigma = seen.cones.take(pick.ravel()), seen.sigma_rad[pick.ravel()]

    def at(rotation: Array, t: Array) -> _Poses:
        turned = np.einsum("kij,knj->kni", rotation, points).reshape(-1, 3)
        c = turned + np.repeat(t, k, axis=0)
        # Keep wrong poses in front of the camera, so that the derivative exists; they will not fit anyway.
        c[:, 2] = np.maximum(c[:, 2], 2 * radius_m)
        r, slope = cones.residuals(c, radius_m)
        return _Poses(rotation, t, turned, r / sigma, slope / sigma[:, :, None])

    def step_at(here: _Poses) -> Array:
        J = np.concatenate([here.slope, -here.slope @ skew(here.turned)], axis=2).reshape(K, 3 * k, 6)
        return _damped_steps(J, here.r.reshape(K, -1))

    def moved(here: _Poses, dx: Array) -> _Poses:
        return at(Rotation.from_rotvec(dx[:, 3:]).as_matrix() @ here.rotation, here.t + dx[:, :3])

    found = gauss_newton(at(rotation, t), step_at, moved, most=steps, settled=0.0)
    return found.rotation, found.t, np.sum(found.r.reshape(K, -1) ** 2, axis=1)


@dataclass(frozen=True, slots=True)
class _Poses:
    """K poses, each with k spheres: all K k spheres turned, their residuals over sigma, and the derivatives of these.

    The derivatives are by the centres in the camera frame.
    """

    rotation: Array  # (K, 3, 3)
    t: Array  # (K, 3)
    turned: Array  # (K k, 3)
    r: Array  # (K k, 3)
    slope: Array  # (K k, 3, 3)


def _damped_steps(J: Array, r: Array) -> Array:
    """Return Gauss–Newton steps (K, 6) from J (K, N, 6) and residuals (K, N), with limited rotations."""
    JJ = J.transpose(0, 2, 1) @ J
    H = JJ + 1e-9 * np.trace(JJ, axis1=1, axis2=2)[:, None, None] * np.eye(6)
    dx = -np.linalg.solve(H, np.einsum("kni,kn->ki", J, r)[:, :, None])[:, :, 0]
    dx[:, 3:] = np.clip(dx[:, 3:], -0.3, 0.3)
    return dx


def _support(seen: Sightings, R: Array, t: Array, centres: Array, radius_m: float) -> tuple[NDArray[np.int64], Array]:
    """Count the detections (K,) that each pose explains within loose gates; return their mean angle in radii too."""
    counts = np.zeros(len(R), dtype=np.int64)
    error = np.zeros(len(R))
    for start in range(0, len(R), 2000):
        part = slice(start, start + 2000)
        c = np.einsum("kij,mj->kmi", R[part], centres) + t[part, None]
        distance = np.maximum(np.linalg.norm(c, axis=2), 2 * radius_m)
        cosine = np.einsum("dj,kmj->kdm", seen.cones.axes, c / distance[..., None])
        half = np.arcsin(radius_m / distance)
        angle = np.arccos(np.clip(cosine, -1, 1)) / half[:, None, :]
        ratio = seen.cones.half_angles[None, :, None] / half[:, None, :]
        angle[(angle > _LOOSE.place) | (np.abs(ratio - 1) > _LOOSE.size)] = np.inf
        nearest = angle.min(axis=2)
        ok = np.isfinite(nearest)
        counts[part] = ok.sum(axis=1)
        error[part] = np.where(ok, nearest, 0).sum(axis=1) / np.maximum(ok.sum(axis=1), 1)
    return counts, error


def _refine(
    seen: Sightings,
    markers: dict[int, int],
    rotation: Array,
    t: Array,
    centres: Array,
    radius_m: float,
    focal_px: float,
) -> Hypothesis | None:
    """Solve an assignment from all its outlines, without those that do not fit and with further ones that do."""
    for _ in range(6):
        pick, chosen = np.array(list(markers)), np.array(list(markers.values()))
        new_R, new_t, _ = _pose_steps(seen, pick[None], centres[chosen][None], rotation[None], t[None], radius_m, 5)
        T = transform(new_R[0], new_t[0])
        c = apply(T, centres)
        if np.any(c[chosen][:, 2] < 2 * radius_m):
            return None
        r, _ = seen.cones.take(pick).residuals(c[chosen], radius_m)
        own = np.sum((r / seen.sigma_rad[pick]) ** 2, axis=1)
        if own.max() > _OUTLINE_CHI2:
            if len(markers) < 5:
                return None
            worst = int(pick[int(np.argmax(own))])
            markers = {d: m for d, m in markers.items() if d != worst}
            continue
        near = {d: m for d, m, _ in match(seen, c, radius_m, _CLOSE)}
        more = {d: m for d, m in near.items() if d not in markers and m not in markers.values()}
        fresh = np.array(list(more), dtype=np.int64)
        if len(fresh):
            at = c[np.array(list(more.values()))]
            s, _ = seen.cones.take(fresh).residuals(at, radius_m)
            fits = np.sum((s / seen.sigma_rad[fresh]) ** 2, axis=1) < _OUTLINE_CHI2
            more = {int(d): more[int(d)] for d in fresh[fits]}
        if not more:
            chi2 = float(own.sum())
            # Six of the parameters determine the pose: the remaining residuals must look like noise.
            free = 3 * len(markers) - 6
            if chi2 > free + 4.5 * np.sqrt(2 * free) + 6:
                return None
            rms = float(np.sqrt(np.mean(np.sum(r[:, :2] ** 2, axis=1))))
            return Hypothesis(markers, T, rms * focal_px, _EVIDENCE * len(markers) - chi2 / 2)
        markers, rotation, t = {**markers, **more}, new_R[0], new_t[0]
    return None
