"""Least-squares adjustment of spheres, camera poses and intrinsics to outlines in photographs, with priors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton, largest
from service.compute.markers.cones import Cone
from service.compute.markers.records import SphereOutline
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, transform

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
