"""Sphere centres from photographs of an uncalibrated camera: adjusted with its poses and intrinsics to outlines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton, largest
from service.compute.layout.ambiguity import distances
from service.compute.markers.cones import Cone
from service.compute.markers.records import SphereOutline
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, inverse, transform

IntArray = NDArray[np.int64]

_RIM: Array = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)  # azimuths of the rays that represent an outline
_LENS = 8  # focal length, fy over fx, cx, cy, k1, k2, p1, p2
_ITERATIONS = 12
_DONE = 1e-6  # metres and radians
_LONGEST_STEP = 0.1
# Outlines err by more than their given covariance: chi² per coordinate in bench/results/outlines*.md.
_OUTLINE_CHI2 = 1.5
_DOUBTFUL = 3.5  # standard deviations beyond which an outline is downweighted


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Prior standard deviations of a camera's parameters.

    Attributes:
        focal: focal length, relative, common to all photographs.
        refocused: focal length of one photograph against the others', relative, since the lens may have been
            refocused.
        aspect: ratio of fy to fx.
        centre: principal point, relative to the image's width.
        k1, k2: coefficients of radial distortion.
        tangential: coefficients p1 and p2.
    """

    focal: float = 0.02
    refocused: float = 0.002
    aspect: float = 5e-4
    centre: float = 0.006
    k1: float = 0.1
    k2: float = 0.1
    tangential: float = 1e-3

    def sigmas(self) -> Array:
        """Return (8,) standard deviations in the order of the lens parameters."""
        return np.array(
            [self.focal, self.aspect, self.centre, self.centre, self.k1, self.k2, self.tangential, self.tangential]
        )


CALIBRATED = LensPrior(focal=2e-4, refocused=1e-4, aspect=5e-5, centre=2e-4, k1=1e-3, k2=4e-3, tangential=5e-5)


@dataclass(frozen=True, slots=True)
class SpherePhotograph:
    """Sphere outlines of one photograph, interpreted with a nominal camera.

    Attributes:
        camera: the nominal camera.
        cones: one for each outline, from the nominal camera.
        covariances: (n, 3, 3), as SphereOutline.cone_covariance.
    """

    camera: CameraModel
    cones: tuple[Cone, ...]
    covariances: Array

    @classmethod
    def of(cls, camera: CameraModel, outlines: Sequence[SphereOutline]) -> SpherePhotograph:
        """Build it from the outlines that the detector found with this camera."""
        return cls(
            camera,
            tuple(o.cone for o in outlines),
            np.array([o.cone_covariance for o in outlines]).reshape(-1, 3, 3),
        )

    def rim_px(self) -> Array:
        """Return (n, 12, 2) points on every outline, in pixels of the image as captured."""
        rays = [cone.rays(_RIM, np.full_like(_RIM, cone.half_angle_rad)) for cone in self.cones]
        return np.array([self.camera.project(r) for r in rays]).reshape(-1, len(_RIM), 2)


@dataclass(frozen=True, slots=True)
class AdjustedLayout:
    """The adjusted spheres and poses.

    Attributes:
        centres_m: (N, 3) centres in the frame of the first photograph.
        covariance: (3N, 3N) m² of all centres jointly, including the camera's uncertainty.
        T_photo_first: the map from the first photograph's frame to each photograph's own.
        chi2: chi square per degree of freedom; if above 1, the covariance is scaled by it.
    """

    centres_m: Array
    covariance: Array
    T_photo_first: tuple[Transform, ...]
    chi2: float


def adjust(
    photographs: Sequence[SpherePhotograph],
    spheres: Sequence[IntArray],
    centres_m: Array,
    T_photo_first: Sequence[Transform],
    radius_m: float,
    prior: LensPrior,
) -> AdjustedLayout:
    """Adjust spheres, poses and camera to all outlines by Gauss–Newton with Huber weights.

    Args:
        photographs: photographs taken by one camera.
        spheres: (n,) index of each outline's sphere, for every photograph.
        centres_m: (N, 3) initial centres; each sphere must be seen in some photograph.
        T_photo_first: initial poses; the first one stays the identity.
        radius_m: radius of the spheres, which defines the scale.
        prior: prior of the camera's parameters.

    Raises:
        ComputeError: no convergence, because the outlines do not fit together.
    """
    problem = _Problem.of(photographs, spheres, radius_m, prior, len(centres_m))
    x = _State(
        np.array(centres_m, dtype=np.float64),
        np.array([T[:3, :3] for T in T_photo_first]),
        np.array([T[:3, 3] for T in T_photo_first]),
        np.zeros(_LENS),
        np.zeros(len(photographs)),
    )

    def size(step: Array) -> float:
        return largest(step[problem.geometry])

    x = gauss_newton(
        x,
        lambda x: problem.step(x)[0],
        lambda x, step: problem.moved(x, step * min(1.0, _LONGEST_STEP / max(size(step), 1e-12))),
        most=_ITERATIONS,
        settled=_DONE,
        size=lambda _state, step: size(step),
    )
    _, covariance, chi2 = problem.step(x)
    count = 3 * len(centres_m)
    return AdjustedLayout(
        x.centres,
        covariance[:count, :count] * max(1.0, chi2),
        tuple(transform(R, t) for R, t in zip(x.rotations, x.shifts, strict=True)),
        chi2,
    )


@dataclass(frozen=True, slots=True)
class _State:
    centres: Array  # (N, 3)
    rotations: Array  # (K, 3, 3)
    shifts: Array  # (K, 3)
    lens: Array  # (8,) differences from the nominal camera
    focal: Array  # (K,) relative


@dataclass(frozen=True, slots=True)
class _Problem:
    rim_px: Array  # (M, 12, 2)
    photo: IntArray  # (M,)
    sphere: IntArray  # (M,)
    whiten: Array  # (M, 3, 3)
    nominal: Array  # (M, 4) fx, fy, cx, cy
    width: float
    lens_nominal: Array  # (4,) k1, k2, p1, p2
    radius_m: float
    prior: LensPrior
    n_spheres: int
    n_photos: int

    @classmethod
    def of(
        cls,
        photographs: Sequence[SpherePhotograph],
        spheres: Sequence[IntArray],
        radius_m: float,
        prior: LensPrior,
        n_spheres: int,
    ) -> _Problem:
        covariances = _OUTLINE_CHI2 * np.concatenate([p.covariances for p in photographs])
        # Measurements below are (half angle, axis), but the covariance is (axis, half angle).
        order = np.array([2, 0, 1])
        ordered = covariances[:, order][:, :, order]
        camera = photographs[0].camera
        return cls(
            rim_px=np.concatenate([p.rim_px() for p in photographs]),
            photo=np.repeat(np.arange(len(photographs)), [len(p.cones) for p in photographs]),
            sphere=np.concatenate(list(spheres)).astype(np.int64),
            whiten=np.asarray(np.linalg.inv(np.linalg.cholesky(ordered)), dtype=np.float64),
            nominal=np.repeat(
                np.array([[p.camera.fx, p.camera.fy, p.camera.cx, p.camera.cy] for p in photographs]),
                [len(p.cones) for p in photographs],
                axis=0,
            ),
            width=float(camera.width),
            lens_nominal=np.array([camera.k1, camera.k2, camera.p1, camera.p2]),
            radius_m=radius_m,
            prior=prior,
            n_spheres=n_spheres,
            n_photos=len(photographs),
        )

    @property
    def geometry(self) -> slice:
        """The columns of lengths and angles: centres, then six for every photograph but the first."""
        return slice(0, 3 * self.n_spheres + 6 * (self.n_photos - 1))

    def step(self, x: _State) -> tuple[Array, Array, float]:
        """Return a Gauss–Newton step, the covariance of all unknowns, and chi² per degree of freedom."""
        n_geometry = self.geometry.stop
        m, J = self._rows(x)
        n = J.shape[2]
        white_m = np.einsum("mij,mj->mi", self.whiten, m)
        size = np.sqrt(np.mean(white_m**2, axis=1))
        weight = np.sqrt(np.minimum(1.0, _DOUBTFUL / np.maximum(size, 1e-9)))
        white_J = (weight[:, None, None] * np.einsum("mij,mjk->mik", self.whiten, J)).reshape(-1, n)
        white_m = (weight[:, None] * white_m).ravel()
        priors = np.zeros(n)
        priors[n_geometry:] = (
            np.concatenate([self.prior.sigmas(), np.full(self.n_photos, self.prior.refocused)]) ** -2
        )
        at = np.concatenate([np.zeros(n_geometry), x.lens, x.focal])
        normal = white_J.T @ white_J + np.diag(priors)
        try:
            covariance = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            raise ComputeError("the outlines of these photographs do not fit together") from None
        if not np.isfinite(covariance).all():
            raise ComputeError("the outlines of these photographs do not fit together")
        step = -covariance @ (white_J.T @ white_m + priors * at)
        freedom = max(white_m.size - n_geometry, 1)
        chi2 = float(white_m @ white_m + at @ (priors * at)) / freedom
        return step, covariance, chi2

    def _rows(self, x: _State) -> tuple[Array, Array]:
        """Return the differences (M, 3) of the outlines, and their derivative (M, 3, n) by all unknowns."""
        n_centres, n_geometry = 3 * self.n_spheres, self.geometry.stop
        seen = np.einsum("mij,mj->mi", x.rotations[self.photo], x.centres[self.sphere]) + x.shifts[self.photo]
        focal = x.focal[self.photo]
        m = self._measure(seen, x.lens, focal)
        by_place = self._derivative(lambda d: self._measure(seen + d, x.lens, focal), m, np.full(3, 1e-6))
        by_lens = self._derivative(lambda d: self._measure(seen, x.lens + d, focal), m, np.full(_LENS, 1e-6))
        J = np.zeros((len(m), 3, n_geometry + _LENS + self.n_photos))
        rows = np.arange(len(m))
        turned = np.einsum("mij,mjk->mik", by_place, x.rotations[self.photo])
        for axis in range(3):
            J[rows, :, 3 * self.sphere + axis] = turned[:, :, axis]
        later = self.photo > 0
        offset = n_centres + 6 * (self.photo[later] - 1)
        by_turn = np.cross(seen[later, None] - x.shifts[self.photo[later], None], by_place[later])
        for axis in range(3):
            J[rows[later], :, offset + axis] = by_turn[:, :, axis]
            J[rows[later], :, offset + 3 + axis] = by_place[later][:, :, axis]
        J[:, :, n_geometry : n_geometry + _LENS] = by_lens
        J[rows, :, n_geometry + _LENS + self.photo] = by_lens[:, :, 0]
        return m, J

    def moved(self, x: _State, step: Array) -> _State:
        """Return the state after a step."""
        n_centres, n_geometry = 3 * self.n_spheres, self.geometry.stop
        turns = step[n_centres:n_geometry].reshape(-1, 6)
        R = np.array(x.rotations)
        R[1:] = Rotation.from_rotvec(turns[:, :3]).as_matrix() @ R[1:] if len(turns) else R[1:]
        t = np.array(x.shifts)
        t[1:] += turns[:, 3:]
        return replace(
            x,
            centres=x.centres + step[:n_centres].reshape(-1, 3),
            rotations=R,
            shifts=t,
            lens=x.lens + step[n_geometry : n_geometry + _LENS],
            focal=x.focal + step[n_geometry + _LENS :],
        )

    def _measure(self, seen: Array, lens: Array, focal: Array) -> Array:
        """Return (M, 3) size and axis differences of the outlines from those of spheres at `seen` (M, 3).

        They are not ObservedCones.residuals, because the observed cones change with the lens: the rim's pixels are
        undistorted again and compared with the predicted cone.
        """
        scale = 1.0 + lens[0] + focal
        fx, fy = self.nominal[:, 0] * scale, self.nominal[:, 1] * scale * (1.0 + lens[1])
        centre = self.nominal[:, 2:] + lens[2:4] * self.width
        xd = (self.rim_px[..., 0] - centre[:, :1]) / fx[:, None]
        yd = (self.rim_px[..., 1] - centre[:, 1:]) / fy[:, None]
        rays = _undistorted(xd, yd, self.lens_nominal + lens[4:])
        distance = np.linalg.norm(seen, axis=1)
        axis = (seen / distance[:, None])[:, None]
        angle = np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=2), np.sum(rays * axis, axis=2))
        gap = angle - np.arcsin(np.minimum(self.radius_m / distance, 0.9))[:, None]
        # Shifting the axis by d changes the angle to a ray at azimuth φ by -d·(cos φ, sin φ).
        return np.stack(
            [gap.mean(axis=1), -2 * (gap * np.cos(_RIM)).mean(axis=1), -2 * (gap * np.sin(_RIM)).mean(axis=1)], axis=1
        )

    @staticmethod
    def _derivative(measure: Callable[[Array], Array], m: Array, deltas: Array) -> Array:
        """Return (M, 3, len(deltas)) derivatives by finite differences."""
        steps = np.diag(deltas)
        return np.stack([(measure(d) - m) / h for d, h in zip(steps, deltas, strict=True)], axis=2)


def _undistorted(xd: Array, yd: Array, distortion: Array) -> Array:
    """Return the unit rays (M, 12, 3) of distorted normalised coordinates, by fixed-point iteration as in OpenCV."""
    k1, k2, p1, p2 = distortion
    x, y = xd, yd
    for _ in range(6):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        x, y = (
            (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    rays = np.stack([x, y, np.ones_like(x)], axis=2)
    return rays / np.linalg.norm(rays, axis=2, keepdims=True)


LEAST_SPHERES = 4
_TOLERANCE_M = 0.015  # between centres from two single photographs: depths err by some millimetres
_TRIANGLES = 10  # largest triangles of the leading photograph, with which poses of another are proposed
_PROPOSALS = 4000
_READINGS = 3  # assignments of one photograph that are tried in the joint adjustment
_APART = 1.5  # radii, least distance of two centres: 2 for spheres that touch, less their uncertainty
_ASIDE, _BEHIND = (
    0.5,
    4.0,
)  # radii: of an outline's ray from a sphere that is not seen, and of its depth by size from it
_WORST_CHI2 = 20.0  # per degree of freedom: above it, the photograph shows something else


@dataclass(frozen=True, slots=True)
class PhotoLayout:
    """The spheres of all photographs in one frame.

    Attributes:
        centres_m: (N, 3) centres in the frame of the leading photograph.
        covariance: (3N, 3N) m² of all centres jointly.
        spheres: the sphere of each of a photograph's outlines (-1: none), for every photograph; an empty array if the
            photograph could not be used.
        T_photo_first: the map from the centres' frame to each photograph's own; None if it could not be used.
        chi2: chi square of the adjustment, per degree of freedom.
    """

    centres_m: Array
    covariance: Array
    spheres: tuple[IntArray, ...]
    T_photo_first: tuple[Transform | None, ...]
    chi2: float

    @property
    def used(self) -> int:
        """Number of photographs used."""
        return sum(T is not None for T in self.T_photo_first)


def layout_from_photographs(
    photographs: Sequence[SpherePhotograph], radius_m: float, prior: LensPrior, expected: int | None = None
) -> PhotoLayout:
    """Compute one layout from photographs of spheres that did not move in between.

    The photograph with the most spheres leads. From a single photograph, depths follow from the outlines' sizes, to
    some tenths of a millimetre at best. With a second viewpoint they follow from the directions, ten times better,
    and the camera is calibrated at the same time.

    Args:
        photographs: photographs taken by one camera.
        radius_m: radius of the spheres.
        prior: prior of the camera's parameters.
        expected: number of spheres; if more are found, those seen in the fewest photographs are dropped.

    Raises:
        ComputeError: no photograph shows four spheres.
    """
    order = sorted(range(len(photographs)), key=lambda k: -len(photographs[k].cones))
    if not order or len(photographs[order[0]].cones) < LEAST_SPHERES:
        most = max((len(p.cones) for p in photographs), default=0)
        raise ComputeError(
            f"no photograph shows more than {most} spheres, {LEAST_SPHERES} are needed",
            remedy="Photograph all spheres from above, sharp and from less than a metre",
        )
    first = photographs[order[0]]
    group = _Group([order[0]], [np.arange(len(first.cones))], [np.eye(4)])
    found = _adjusted(photographs, group, places_by_size(first.cones, radius_m), radius_m, prior)
    for k in order[1:]:
        group, found = _add_photograph(photographs, group, found, k, radius_m, prior)
    if expected is not None and len(found.centres_m) > expected:
        group, found = _reduced(photographs, group, found, expected, radius_m, prior)
    spheres: list[IntArray] = [np.empty(0, dtype=np.int64)] * len(photographs)
    poses: list[Transform | None] = [None] * len(photographs)
    for k, ids, T in zip(group.photographs, group.spheres, found.T_photo_first, strict=True):
        spheres[k], poses[k] = ids, T
    return PhotoLayout(found.centres_m, found.covariance, tuple(spheres), tuple(poses), found.chi2)


@dataclass(frozen=True, slots=True)
class _Group:
    """The photographs registered so far: their numbers, the spheres of their outlines (-1: none), their poses."""

    photographs: list[int]
    spheres: list[IntArray]
    poses: list[Transform]


def _adjusted(
    photographs: Sequence[SpherePhotograph], group: _Group, centres: Array, radius_m: float, prior: LensPrior
) -> AdjustedLayout:
    chosen: list[SpherePhotograph] = []
    spheres: list[IntArray] = []
    for k, ids in zip(group.photographs, group.spheres, strict=True):
        shown = np.nonzero(ids >= 0)[0]
        photo = photographs[k]
        chosen.append(SpherePhotograph(photo.camera, tuple(photo.cones[i] for i in shown), photo.covariances[shown]))
        spheres.append(ids[shown])
    return adjust(chosen, spheres, centres, group.poses, radius_m, prior)


def _add_photograph(
    photographs: Sequence[SpherePhotograph],
    group: _Group,
    found: AdjustedLayout,
    k: int,
    radius_m: float,
    prior: LensPrior,
) -> tuple[_Group, AdjustedLayout]:
    """Return the group with photograph k added by its best-fitting assignment; unchanged if none fits."""
    places = places_by_size(photographs[k].cones, radius_m)
    best: tuple[_Group, AdjustedLayout] | None = None
    best_rank = (True, np.inf)
    for T_first_photo, pairs in _readings(found.centres_m, places):
        ids = np.full(len(places), -1, dtype=np.int64)
        for sphere, outline in pairs:
            ids[outline] = sphere
        new = np.nonzero(ids < 0)[0]
        ids[new] = len(found.centres_m) + np.arange(len(new))
        centres = np.concatenate([found.centres_m, apply(T_first_photo, places[new])])
        joined = _Group(
            [*group.photographs, k], [*group.spheres, ids], [*found.T_photo_first, inverse(T_first_photo)]
        )
        try:
            adjusted = _adjusted(photographs, joined, centres, radius_m, prior)
            single = _without_doubles(joined, adjusted, len(found.centres_m), radius_m)
            if len(single[1]) < len(adjusted.centres_m):
                joined, adjusted = single[0], _adjusted(photographs, *single, radius_m, prior)
        except ComputeError:
            continue  # this assignment does not fit
        # Spheres are solid: an assignment by which two still overlap counts only if there is no other.
        rank = (_nearest_m(adjusted.centres_m) < _APART * radius_m, adjusted.chi2)
        if adjusted.chi2 < _WORST_CHI2 and (best is None or rank < best_rank):
            best, best_rank = (joined, adjusted), rank
    return (group, found) if best is None else best


def _without_doubles(joined: _Group, adjusted: AdjustedLayout, known: int, radius_m: float) -> tuple[_Group, Array]:
    """Drop the newest photograph's spheres that are known ones from the group and its centres.

    Spheres are solid: one that lies in a known one is that sphere, or outlined twice, and then none. In the direction
    of a known sphere that the photograph shows nowhere else, the outline is that sphere's, though by its size it is
    nearer or farther.

    Args:
        joined: the group, with the newest photograph last.
        adjusted: the group's layout.
        known: number of spheres before that photograph; its own come behind.
        radius_m: radius of the spheres.
    """
    ids = joined.spheres[-1].copy()
    kept = np.ones(len(adjusted.centres_m), dtype=bool)
    seen = apply(adjusted.T_photo_first[-1], adjusted.centres_m)
    ray = seen[known:] / np.linalg.norm(seen[known:], axis=1, keepdims=True)
    along = np.abs(ray @ seen[:known].T - np.linalg.norm(seen[known:], axis=1, keepdims=True))
    gap = distances(adjusted.centres_m)[known:, :known]
    aside = np.sqrt(np.maximum(gap**2 - along**2, 0.0))
    inside, behind = gap < _APART * radius_m, (aside < _ASIDE * radius_m) & (along < _BEHIND * radius_m)
    for row in np.argsort(gap.min(axis=1), kind="stable"):
        unseen = ~np.isin(np.arange(known), ids)
        same = np.flatnonzero(inside[row] | (behind[row] & unseen))
        if len(same):
            sphere = int(same[np.argmin(aside[row, same])])
            ids[ids == known + row] = sphere if unseen[sphere] else -1
            kept[known + row] = False
    number = np.append(np.cumsum(kept) - 1, -1)  # the last for outlines of no sphere
    spheres = [number[one] for one in (*joined.spheres[:-1], ids)]
    return _Group(joined.photographs, spheres, list(adjusted.T_photo_first)), adjusted.centres_m[kept]


def _nearest_m(centres: Array) -> float:
    """Return the least distance between two of the centres (N, 3)."""
    return float(distances(centres)[~np.eye(len(centres), dtype=bool)].min())


def _reduced(
    photographs: Sequence[SpherePhotograph],
    group: _Group,
    found: AdjustedLayout,
    expected: int,
    radius_m: float,
    prior: LensPrior,
) -> tuple[_Group, AdjustedLayout]:
    """Drop the spheres seen in the fewest photographs, which are other round objects."""
    count = np.bincount(np.concatenate([i[i >= 0] for i in group.spheres]), minlength=len(found.centres_m))
    kept = np.sort(np.argsort(-count, kind="stable")[:expected])
    if count[kept].min() == count[np.setdiff1d(np.arange(len(count)), kept)].max():
        return group, found  # a tie: nothing shows which are wrong, and the wrong count is reported
    number = np.full(len(count) + 1, -1, dtype=np.int64)
    number[kept] = np.arange(expected)
    smaller = _Group(group.photographs, [number[ids] for ids in group.spheres], list(found.T_photo_first))
    return smaller, _adjusted(photographs, smaller, found.centres_m[kept], radius_m, prior)


def places_by_size(cones: Sequence[Cone], radius_m: float) -> Array:
    """Return (n, 3) centres in the photograph's own frame, with depths from the outlines' sizes."""
    return np.array(
        [cone.axis * (radius_m / np.sin(cone.half_angle_rad)) for cone in cones], dtype=np.float64
    ).reshape(-1, 3)


def _readings(a: Array, b: Array) -> list[tuple[Transform, list[tuple[int, int]]]]:
    """Return T_a_b and pairs (index in a, index in b) for every way in which b (N, 3) matches a (M, 3), best first.

    Nearly symmetric layouts match in more than one way: the adjustment decides between them, and if it cannot, the
    layout is the same either way.
    """
    if min(len(a), len(b)) < LEAST_SPHERES:
        return []
    rows, columns = _alike_triangles(a, b)
    T = _rigid(a[rows], b[columns])
    gap = np.linalg.norm(
        a[None, :, None] - (np.einsum("mij,nj->mni", T[:, :3, :3], b) + T[:, None, :3, 3])[:, None], axis=3
    )
    nearest = gap.min(axis=1)
    score = np.sum(np.minimum(nearest / _TOLERANCE_M, 1.0) ** 2, axis=1)
    found: dict[tuple[tuple[int, int], ...], tuple[float, Transform]] = {}
    for m in np.argsort(score, kind="stable")[:40]:
        pairs, refined, cost = _refined(a, b, T[m])
        if len(pairs) >= LEAST_SPHERES:
            found.setdefault(tuple(pairs), (cost + 2.0 * (len(b) - len(pairs)), refined))
    ranked = sorted(found.items(), key=lambda item: item[1][0])[:_READINGS]
    return [(value[1], list(pairs)) for pairs, value in ranked]


def _refined(a: Array, b: Array, start: Transform) -> tuple[list[tuple[int, int]], Transform, float]:
    """Return pairs within the tolerance, their fitted pose, and their sum of squares relative to the tolerance's."""
    pairs: list[tuple[int, int]] = []
    cost, T_a_b = float("inf"), start
    for _ in range(2):
        gap = np.linalg.norm(a[:, None] - apply(T_a_b, b)[None], axis=2)
        rows, columns = linear_sum_assignment(np.minimum(gap, 2 * _TOLERANCE_M))
        near = gap[rows, columns] < _TOLERANCE_M
        pairs = [(int(i), int(j)) for i, j in zip(rows[near], columns[near], strict=True)]
        if len(pairs) < LEAST_SPHERES:
            break
        cost = float(np.sum((gap[rows[near], columns[near]] / _TOLERANCE_M) ** 2))
        T_a_b, _ = align_points(a[rows[near]], b[columns[near]])
    return pairs, T_a_b, cost


def _alike_triangles(a: Array, b: Array) -> tuple[IntArray, IntArray]:
    """Return index triples (M, 3) into a (its largest triangles only) and into b, with equal sides."""
    da, db = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in (a, b))
    i, j, k = np.array([(p, q, r) for p in range(len(a)) for q in range(p) for r in range(q)]).T
    area = np.linalg.norm(np.cross(a[j] - a[i], a[k] - a[i]), axis=1)
    rows: list[IntArray] = []
    columns: list[IntArray] = []
    for t in np.argsort(-area, kind="stable")[:_TRIANGLES]:
        p, q, r = i[t], j[t], k[t]
        agree = (
            (np.abs(db - da[p, q]) < _TOLERANCE_M)[:, :, None]
            & (np.abs(db - da[p, r]) < _TOLERANCE_M)[:, None, :]
            & (np.abs(db - da[q, r]) < _TOLERANCE_M)[None]
        )
        found = np.argwhere(agree)
        found = found[(found[:, 0] != found[:, 1]) & (found[:, 0] != found[:, 2]) & (found[:, 1] != found[:, 2])]
        columns.append(found)
        rows.append(np.tile(np.array([p, q, r]), (len(found), 1)))
    return np.concatenate(rows)[:_PROPOSALS], np.concatenate(columns)[:_PROPOSALS]


def _rigid(a: Array, b: Array) -> Array:
    """Return T_a_b (M, 4, 4) for point triples a, b (M, 3, 3). Source: as `align_points`."""
    mean_a, mean_b = a.mean(axis=1), b.mean(axis=1)
    H = np.einsum("mki,mkj->mij", b - mean_b[:, None], a - mean_a[:, None])
    U, _, Vt = np.linalg.svd(H)
    flip = np.ones((len(a), 3))
    flip[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = np.einsum("mji,mj,mkj->mik", Vt, flip, U)
    T[:, :3, 3] = mean_a - np.einsum("mij,mj->mi", T[:, :3, :3], mean_b)
    return T
