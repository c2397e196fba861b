"""Computes the residuals of outlines, the paper's x^T E x or Sampson's distance, and linearises a registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import ObservedCones
from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, skew

PointCost = Literal["sampson", "algebraic"]
Cost = Literal["cone", "sampson", "algebraic"]


def residuals(points: Array, centres_camera_m: Array, radius_m: float, cost: PointCost) -> Array:
    """Return signed residuals (N,) of normalised points (N, 3), z = 1, against spheres at (N, 3) in the camera frame.

    The outline of a sphere is x^T E x = 0 with E^-1 = P Q^-1 P^T. In the camera frame P = [I | 0] and
    Q^-1 ~ [[r^2 I - c c^T, -c], [-c^T, -1]], hence E ~ (|c|^2 - r^2) I - c c^T.

    `algebraic`: x^T E x with E of unit Frobenius norm (no unit). `sampson`: x^T E x over the norm of its gradient in
    the image plane, the distance to the outline to first order, in units of the normalised plane.
    """
    return _value_and_gradient(points, centres_camera_m, radius_m, cost, derivative=False)[0]


def residuals_and_derivative(
    points: Array, centres_camera_m: Array, radius_m: float, cost: PointCost
) -> tuple[Array, Array]:
    """Return the residuals (N,) as from `residuals`, and their derivative (N, 3) by the centres."""
    return _value_and_gradient(points, centres_camera_m, radius_m, cost, derivative=True)


def _value_and_gradient(
    points: Array, centres: Array, radius_m: float, cost: PointCost, *, derivative: bool
) -> tuple[Array, Array]:
    xx = np.einsum("nj,nj->n", points, points)
    cx = np.einsum("nj,nj->n", centres, points)
    cc = np.einsum("nj,nj->n", centres, centres)
    a = cc - radius_m**2
    value = a * xx - cx**2
    d_value = 2 * (xx[:, None] * centres - cx[:, None] * points) if derivative else np.empty((0, 3))
    if cost == "algebraic":
        # |a I - c c^T|_F^2 = 3 a^2 - 2 a |c|^2 + |c|^4
        norm2 = 3 * a**2 - 2 * a * cc + cc**2
        norm = np.sqrt(norm2)
        if derivative:
            d_norm2 = (6 * a - 2 * cc - 2 * a + 2 * cc)[:, None] * 2 * centres
            d_value = d_value / norm[:, None] - (value / (2 * norm2 * norm))[:, None] * d_norm2
        return value / norm, d_value
    g = 2 * (a[:, None] * points[:, :2] - cx[:, None] * centres[:, :2])
    length = np.linalg.norm(g, axis=1)
    if derivative:
        # d g_i / d c_j = 2 (2 c_j x_i - x_j c_i - (c.x) delta_ij), i in the image plane
        along = np.einsum("ni,ni->n", g, points[:, :2])
        across = np.einsum("ni,ni->n", g, centres[:, :2])
        d_length = 2 * (2 * along[:, None] * centres - across[:, None] * points)
        d_length[:, :2] -= 2 * cx[:, None] * g
        d_length /= length[:, None]
        d_value = d_value / length[:, None] - (value / length**2)[:, None] * d_length
    return value / length, d_value


@dataclass(frozen=True, slots=True)
class CommonErrors:
    """Standard deviations, in px, of errors shared by all outlines of a capture.

    `shift_px`: in x and in y of the image; `growth_px`: of the radius. Views from different sides separate both from
    the registration, so they are estimated. `light_px`: displacement of all spheres in one direction of space, per
    coordinate, at their mean distance: under light from one side, the detected edge is biased differently on the lit
    and on the dark limb. No view separates it from a displacement of the scan, so this part of the predicted error
    remains however many images are taken. `own_light_px`: displacement, per coordinate, of each sphere by light that
    is its own, from the specimen and the table beside it, alike in all images: it counts as an error of the sphere's
    centre in what is given, but is not estimated, since it would take up other errors.
    """

    shift_px: float
    growth_px: float
    light_px: float
    own_light_px: float = 0.0


# Under light from one side, the detected edge is biased differently on the lit and on the dark limb. The mean of this
# bias around the outline is growth, the difference between the sides is light; both are similar in size. Truth on ten
# rendered scenes with outlines of 60 px radius: growth -0.020…-0.031 px, light 0.016 px rms per coordinate, shift
# 0.003 px in x and 0.008 px in y rms; on three with 150 px radius: growth -0.008 px, light 0.017 px
# (accuracy.py and registration_sigma.py in bench/registration). Other lights, colours and another renderer
# (bench/markers/outlines.py) gave growth of -0.04 px and displacements of single images of 0.05 px rms, so light is
# set above what the first renderer requires. Truth of single spheres in whole runs on simulated rigs, less the noise:
# 0.029 px rms per coordinate at 960 px, 0.009 px at 1280 px (bench/whole_runs/stated_sigma.py).
EXPECTED_COMMON_ERRORS = CommonErrors(shift_px=0.015, growth_px=0.03, light_px=0.02, own_light_px=0.02)


@dataclass(frozen=True, slots=True)
class RegistrationSettings:
    """The unknowns of a registration, its residual, and the uncertainty of what is given.

    Attributes:
        cost: `cone` uses the three parameters and their covariance; `sampson` the points' geometric distances;
            `algebraic` is the paper's plain x^T E x.
        robust: true to weight outlines robustly and exclude outliers.
        pose_covariance: (N, 6, 6) covariance of each pose's (position in the unit of the poses, rotation vector in
            radians) in the axes of its base, independent between images; "estimate": isotropic, estimated from the
            residuals; "exact": no pose errors; "free": the outlines alone determine where each camera was.
        intrinsics_covariance: (4, 4) covariance of fx, fy, cx, cy or (8, 8) of these and k1, k2, p1, p2; only for
            poses whose errors do not depend on the intrinsics'. None leaves them to the error budget.
        common_errors: prior sizes of errors shared by all outlines of a capture.
    """

    cost: Cost = "cone"
    robust: bool = True
    pose_covariance: Array | Literal["estimate", "exact", "free"] = field(default="estimate", repr=False)
    intrinsics_covariance: Array | None = field(default=None, repr=False)
    common_errors: CommonErrors = EXPECTED_COMMON_ERRORS


_CHUNK = 500  # outlines whose points are expanded at a time


@dataclass(frozen=True, slots=True)
class Problem:
    """O outlines of N images from G stations, and everything known before the solution."""

    members: list[tuple[int, int, int]]  # image, outline, marker
    image: NDArray[np.int64]
    marker: NDArray[np.int64]
    group: NDArray[np.int64]  # index into `groups`
    groups: list[int]
    station: NDArray[np.int64]  # (N,) index into `groups`, -1 for a group without outlines
    T_base_camera: Array  # (N, 4, 4)
    centres: Array  # (M, 3)
    radius_m: float
    camera: CameraModel
    focal_px: float
    cones: ObservedCones  # (O,)
    whiten: Array  # (O, 3, 3): whiten @ residual has unit covariance
    outlines: list[SphereOutline] = field(repr=False)  # (O,) their points are only for costs on points
    point_sigma: Array = field(repr=False)  # (O,) of each of the L points if they were independent
    common: Array = field(repr=False)  # (O, 3, K) displacement of a cone by each common error of the images
    common_prior: Array = field(repr=False)  # (K, K) information
    sphere_prior: Array | None = field(repr=False)  # (3 M, 3 M) information; None: centres taken as exact
    light_unit_m: float  # displacement of a sphere that appears as one px
    own_light_m: float  # standard deviation, per coordinate, of a sphere's displacement by light of its own
    with_scale: bool

    @property
    def n_images(self) -> int:
        """Number of images."""
        return len(self.T_base_camera)

    @property
    def scale_column(self) -> int:
        """Column of ln scale, if it is estimated."""
        return 6 * len(self.groups)

    @property
    def sphere_column(self) -> int:
        """First column of the spheres' displacements, if they are estimated."""
        return self.scale_column + int(self.with_scale)

    @property
    def common_column(self) -> int:
        """First column of the common errors."""
        return self.sphere_column + (0 if self.sphere_prior is None else 3 * len(self.centres))

    @property
    def lens_column(self) -> int:
        """First column of the errors of the intrinsics, if they are estimated."""
        return self.common_column + 6

    @property
    def size(self) -> int:
        """Number of common unknowns."""
        return self.common_column + 3 + self.common.shape[2]

    def prior(self) -> Array:
        """Return (n, n) prior information on the common unknowns."""
        out = np.zeros((self.size, self.size))
        if self.sphere_prior is not None:
            out[self.sphere_column : self.common_column, self.sphere_column : self.common_column] = self.sphere_prior
        out[self.common_column :, self.common_column :] = self.common_prior
        return out


@dataclass(frozen=True, slots=True)
class State:
    """Values of the unknowns."""

    bases: Array  # (G, 4, 4) T_base_scan of each station
    scale: float
    spheres: Array  # (M, 3) displacements of the centres, scan frame
    common: Array  # (3 + K,) px: displacement in space (scan frame), shift, growth, and errors of the intrinsics
    poses: Array  # (N, 6) errors of the poses: position (m), rotation vector, base axes

    def moved(self, problem: Problem, dx: Array, poses: Array) -> State:
        """Return the state after a step of the common unknowns, with the pose errors that belong to it."""
        bases = self.bases.copy()
        for k in range(len(bases)):
            d = dx[6 * k : 6 * k + 6]
            bases[k, :3, :3] = Rotation.from_rotvec(d[3:]).as_matrix() @ bases[k, :3, :3]
            bases[k, :3, 3] += d[:3]
        scale = self.scale * float(np.exp(dx[problem.scale_column])) if problem.with_scale else self.scale
        spheres = self.spheres
        if problem.sphere_prior is not None:
            spheres = spheres + dx[problem.sphere_column : problem.common_column].reshape(-1, 3)
        return State(bases, scale, spheres, self.common + dx[problem.common_column :], poses)

    def prior_values(self, problem: Problem) -> Array:
        """Return (n,) current values of the unknowns with a prior, zero for the others."""
        out = np.zeros(problem.size)
        if problem.sphere_prior is not None:
            out[problem.sphere_column : problem.common_column] = self.spheres.ravel()
        out[problem.common_column :] = self.common
        return out

    def cameras(self, problem: Problem, *, refined: bool) -> Array:
        """Return (N, 4, 4) T_base_camera, metric; `refined`: corrected by the estimated pose errors."""
        T = problem.T_base_camera.copy()
        T[:, :3, 3] *= self.scale
        if refined:
            T[:, :3, :3] = Rotation.from_rotvec(self.poses[:, 3:]).as_matrix() @ T[:, :3, :3]
            T[:, :3, 3] += self.poses[:, :3]
        return T


@dataclass(frozen=True, slots=True)
class Linearised:
    """The linearised residuals of the outlines: r + J dx + A xi, where xi is the whole error of the image's pose."""

    J: Array  # (O, 3, n)
    A: Array  # (O, 3, 6)
    r: Array  # (O, 3)


def assemble(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    settings: RegistrationSettings,
) -> Problem:
    """Assemble the problem from the arguments of `register`.

    Raises:
        ComputeError: too few outlines or markers.
    """
    members = [(i, j, m) for i, a in enumerate(assignments) for j, m in sorted(a.markers.items())]
    markers = {m for _, _, m in members}
    if len(markers) < 3:
        raise ComputeError(
            f"{len(members)} outlines of {len(markers)} markers do not determine a registration",
            remedy="Use images in which at least four registration spheres are visible",
        )
    groups, camera = images.stations, images.camera
    used_groups = [int(groups[i]) for i, _, _ in members]
    first = int(groups[0])
    order = sorted(set(used_groups), key=lambda g: (g != first, g))
    f = 0.5 * (camera.fx + camera.fy)
    half = [outlines[i][j].cone.half_angle_rad for i, j, _ in members]
    light_unit_m = float(np.mean(spheres.radius_m / np.sin(half))) / f
    prior = _common_prior(settings)
    empty = Problem(
        members=[],
        image=np.zeros(0, dtype=np.int64),
        marker=np.zeros(0, dtype=np.int64),
        group=np.zeros(0, dtype=np.int64),
        groups=order,
        station=np.array([order.index(int(g)) if int(g) in order else -1 for g in groups]),
        T_base_camera=np.array(images.poses, dtype=np.float64),
        centres=np.asarray(spheres.centres_m, dtype=np.float64),
        radius_m=spheres.radius_m,
        camera=camera,
        focal_px=f,
        cones=ObservedCones.of(()),
        whiten=np.zeros((0, 3, 3)),
        outlines=[],
        point_sigma=np.zeros(0),
        common=np.zeros((0, 3, len(prior) - 3)),
        common_prior=prior,
        sphere_prior=None if spheres.covariance_m2 is None else _block_inverse(spheres.covariance_m2),
        light_unit_m=light_unit_m,
        own_light_m=light_unit_m * settings.common_errors.own_light_px,
        with_scale=not images.metric,
    )
    return with_outlines(empty, outlines, members)


def _common_prior(settings: RegistrationSettings) -> Array:
    """Return information (6 + k, 6 + k) on errors that all outlines share: light, shift and growth, intrinsics."""
    e = settings.common_errors
    sigma = np.maximum([e.light_px, e.light_px, e.light_px, e.shift_px, e.shift_px, e.growth_px], 1e-6)
    common = np.diag(1 / sigma**2)
    if settings.intrinsics_covariance is None:
        return common
    return np.asarray(block_diag(common, np.linalg.inv(settings.intrinsics_covariance)), dtype=np.float64)


def with_outlines(
    problem: Problem, outlines: Sequence[Sequence[SphereOutline]], members: list[tuple[int, int, int]]
) -> Problem:
    """Return the problem with these outlines (image, outline, marker) instead of its own."""
    used = [outlines[i][j] for i, j, _ in members]
    camera, image = problem.camera, np.array([i for i, _, _ in members], dtype=np.int64)
    cones = ObservedCones.of(o.cone for o in used)
    common = _common_displacements(cones, camera)
    n_intrinsics = problem.common.shape[2] - 3
    if n_intrinsics:
        more = _intrinsics_errors(cones, camera)[:, :, :n_intrinsics]
        common = np.concatenate([common, more], axis=2)
    return replace(
        problem,
        members=members,
        image=image,
        marker=np.array([m for _, _, m in members], dtype=np.int64),
        group=problem.station[image],
        cones=cones,
        whiten=_whitening(np.array([o.cone_covariance for o in used])),
        outlines=used,
        point_sigma=np.array([_point_sigma(o) for o in used]) / problem.focal_px,
        common=common,
    )


def _whitening(covariance: Array) -> Array:
    return np.linalg.inv(np.linalg.cholesky(covariance)).astype(np.float64)


def _point_sigma(o: SphereOutline) -> float:
    # L points on a fitted conic have the information of its n edge points, no more. In addition the outline has a
    # systematic error as a whole, shared by two of its parameters.
    variance = max(o.sigma_px, 0.03) ** 2 / max(o.n_edges, 12) + o.systematic_px**2 / 2
    return float(np.sqrt(variance * o.n_points))


def _block_inverse(covariances: Array) -> Array:
    n = len(covariances)
    out = np.zeros((3 * n, 3 * n))
    for k, c in enumerate(covariances):
        out[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.linalg.inv(c)
    return out


def _common_displacements(cones: ObservedCones, camera: CameraModel) -> Array:
    """Return the displacement (O, 3, 3) of cones if all outlines shift by a pixel in x, in y, or grow by one."""
    z = cones.axes[:, 2]
    out = np.zeros((len(cones), 3, 3))
    for k, f in enumerate((camera.fx, camera.fy)):
        out[:, :2, k] = cones.directions[:, k, :] * (z / f)[:, None]
    out[:, 2, 2] = z / (0.5 * (camera.fx + camera.fy))
    return out


def _intrinsics_errors(cones: ObservedCones, camera: CameraModel) -> Array:
    """Return displacements (O, 3, 8) of cones by errors of fx, fy, cx, cy, k1, k2, p1, p2, at fixed image pixels."""
    z = cones.axes[:, 2]
    x, y = cones.axes[:, 0] / z, cones.axes[:, 1] / z
    r2, zero = x**2 + y**2, np.zeros(len(cones))
    plane = -np.stack(
        [
            np.stack([x / camera.fx, zero]), np.stack([zero, y / camera.fy]),
            np.stack([zero + 1 / camera.fx, zero]), np.stack([zero, zero + 1 / camera.fy]),
            np.stack([x * r2, y * r2]), np.stack([x * r2**2, y * r2**2]),
            np.stack([2 * x * y, r2 + 2 * y**2]), np.stack([r2 + 2 * x**2, 2 * x * y]),
        ]
    )  # fmt: skip
    out = np.zeros((len(cones), 3, 8))
    out[:, :2] = np.einsum("oik,cio->okc", cones.directions[:, :2], plane) * z[:, None, None]
    size = [-0.5 / camera.fx + zero, -0.5 / camera.fy + zero, zero, zero, -2 * r2, -3 * r2**2, zero, zero]
    out[:, 2] = (np.stack(size) * cones.half_angles).T
    return out


def linearise(problem: Problem, state: State, cost: Cost) -> Linearised:
    """Return the whitened rows of the outlines at a state, for any of the costs."""
    T = state.cameras(problem, refined=True)[problem.image]
    origin = (problem.T_base_camera[problem.image, :3, 3]) * state.scale
    centres = problem.centres + state.spheres + problem.light_unit_m * state.common[:3]
    rotated = np.einsum("oij,oj->oi", state.bases[problem.group, :3, :3], centres[problem.marker])
    place = rotated + state.bases[problem.group, :3, 3]
    c = np.einsum("oji,oj->oi", T[:, :3, :3], place - T[:, :3, 3])
    in_image = state.common[3:]
    seen, slope = problem.cones.residuals(c, problem.radius_m)
    if cost == "cone":
        seen = seen + problem.common @ in_image
        r = np.einsum("oij,oj->oi", problem.whiten, seen)
        by_centre, by_common = problem.whiten @ slope, problem.whiten @ problem.common
    else:
        equivalent = np.linalg.solve(slope, problem.common)  # the common errors as displacements of the centre
        by_centre, r = _point_rows(problem, c + equivalent @ in_image, cost)
        by_common = by_centre @ equivalent
    S = by_centre @ T[:, :3, :3].transpose(0, 2, 1)  # by a displacement in base axes
    J = np.zeros((len(c), 3, problem.size))
    for k in range(len(problem.groups)):
        here = problem.group == k
        J[here, :, 6 * k : 6 * k + 3] = S[here]
        J[here, :, 6 * k + 3 : 6 * k + 6] = -S[here] @ skew(rotated[here])
    if problem.with_scale:
        J[:, :, problem.scale_column] = -np.einsum("okj,oj->ok", S, origin)
    turned = S @ state.bases[problem.group, :3, :3]
    if problem.sphere_prior is not None:
        for o, m in enumerate(problem.marker):
            J[o, :, problem.sphere_column + 3 * m : problem.sphere_column + 3 * m + 3] = turned[o]
    J[:, :, problem.common_column : problem.common_column + 3] = problem.light_unit_m * turned
    J[:, :, problem.common_column + 3 :] = by_common
    A = np.concatenate([-S, S @ skew(place - T[:, :3, 3])], axis=2)
    # r already includes the current pose errors, but the rows are for their full values.
    return Linearised(J, A, r - np.einsum("okj,oj->ok", A, state.poses[problem.image]))


def _point_rows(problem: Problem, centres: Array, cost: PointCost) -> tuple[Array, Array]:
    """Return three rows per outline with its points' normal equations: derivative (O, 3, 3) and residual (O, 3)."""
    n = len(centres)
    N, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for start in range(0, n, _CHUNK):
        part = range(start, min(n, start + _CHUNK))
        counts = np.array([problem.outlines[o].n_points for o in part])
        flat = np.concatenate([problem.outlines[o].points for o in part])
        flat = np.column_stack([flat, np.ones(len(flat))])
        owner = np.repeat(np.arange(start, start + len(counts)), counts)
        r, D = residuals_and_derivative(flat, centres[owner], problem.radius_m, cost)
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        N[part.start : part.stop] = np.add.reduceat(D[:, :, None] * D[:, None, :], first, axis=0)
        b[part.start : part.stop] = np.add.reduceat(D * r[:, None], first, axis=0)
    if cost == "sampson":
        weight = 1 / problem.point_sigma**2
    else:
        # The paper's cost weights all points equally; a common factor brings its rows to the order of one.
        length = np.trace(N, axis1=1, axis2=2)
        inside = np.einsum("oij,oij->o", problem.whiten, problem.whiten) / np.sum(centres**2, axis=1)
        weight = np.full(n, float(np.median(inside) / np.median(length)))
    L: Array = np.linalg.cholesky(N * weight[:, None, None]).astype(np.float64)
    r = np.linalg.solve(L, (b * weight[:, None])[:, :, None])[:, :, 0]
    return L.transpose(0, 2, 1), r.astype(np.float64)


# Normal equations of the registration, compressed per image, with the errors of the images' poses marginalised.
#
# The linearised model: rows r (three per outline, whitened) + J x + A_i xi_i = noise of variance `factor`, with x
# the unknowns common to all images and xi_i ~ N(0, P_i) the pose error of image i, which moves all its spheres
# together. Of each image only the products of [J A r] are needed: a few kilobytes, however many points or outlines
# it has.


@dataclass(frozen=True, slots=True)
class Blocks:
    """Products of the whitened rows for each of N images; n common unknowns."""

    JJ: Array  # (n, n), summed over the images
    JA: Array  # (N, n, 6)
    AA: Array  # (N, 6, 6)
    Jr: Array  # (N, n)
    Ar: Array  # (N, 6)
    rr: Array  # (N,)
    rows: Array  # (N,) number of rows; those with weights below one count in part


def compress(J: Array, A: Array, r: Array, image: NDArray[np.int64], n_images: int, weights: Array) -> Blocks:
    """Build blocks from outlines' J (O, 3, n), A (O, 3, 6) and r (O, 3), each of an `image` (O,) and a weight."""
    n = J.shape[2]
    root = np.sqrt(weights)[:, None, None]
    F = np.concatenate([J, A, r[:, :, None]], axis=2) * root
    out = np.zeros((n_images, n + 7, n + 7))
    order = np.argsort(image, kind="stable")
    starts = np.searchsorted(image[order], np.arange(n_images + 1))
    for i in range(n_images):
        mine = order[starts[i] : starts[i + 1]]
        if len(mine):
            rows = F[mine].reshape(-1, n + 7)
            out[i] = rows.T @ rows
    counted = np.bincount(image, weights=3.0 * np.minimum(weights, 1.0), minlength=n_images)
    return Blocks(
        out[:, :n, :n].sum(axis=0), out[:, :n, n:-1], out[:, n:-1, n:-1],
        out[:, :n, -1], out[:, n:-1, -1], out[:, -1, -1], counted.astype(np.float64),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Marginal:
    """Normal equations of the common unknowns only: H dx = -g."""

    H: Array  # (n, n)
    g: Array  # (n,)
    quadratic: float  # weighted sum of squares at dx = 0
    log_determinant: float  # of the covariance of all rows
    Q: Array  # (N, 6, 6) covariance of a pose error, given the common unknowns


def marginalise(blocks: Blocks, root: Array, factor: float) -> Marginal:
    """Integrate out the pose errors, xi_i = root_i z with z ~ N(0, I); `root` is (N, 6, 6), zero for exact poses."""
    root_T = root.transpose(0, 2, 1)
    inner = np.eye(6) + root_T @ blocks.AA @ root / factor
    Q = root @ np.linalg.inv(inner) @ root_T
    JQ = blocks.JA @ Q
    n = len(blocks.JJ)
    left = JQ.transpose(1, 0, 2).reshape(n, -1)
    H = blocks.JJ / factor - left @ blocks.JA.transpose(1, 0, 2).reshape(n, -1).T / factor**2
    g = blocks.Jr.sum(axis=0) / factor - left @ blocks.Ar.ravel() / factor**2
    quadratic = float(blocks.rr.sum() / factor - np.einsum("ni,nij,nj->", blocks.Ar, Q, blocks.Ar) / factor**2)
    log_determinant = float(np.linalg.slogdet(inner)[1].sum() + blocks.rows.sum() * np.log(factor))
    return Marginal((H + H.T) / 2, g, quadratic, log_determinant, Q)


def pose_errors(blocks: Blocks, marginal: Marginal, dx: Array, factor: float) -> Array:
    """Return the most probable pose errors (N, 6) for a step dx of the common unknowns."""
    return -np.einsum("nij,nj->ni", marginal.Q, blocks.Ar + np.einsum("nki,k->ni", blocks.JA, dx)) / factor


def outline_and_pose_shares(blocks: Blocks, marginal: Marginal, root: Array, factor: float) -> tuple[Array, Array]:
    """Return the parts (n, n) of H due to the noise of the outlines and to that of the poses; they sum to H.

    With R = C + A P A' they are J' R^-1 C R^-1 J and J' R^-1 A P A' R^-1 J.
    """
    # A' R^-1 J = A' C^-1 J - A' C^-1 A Q A' C^-1 J, with C^-1 the whitened product over the factor.
    AJ = blocks.JA.transpose(0, 2, 1) / factor
    through = AJ - blocks.AA @ marginal.Q @ AJ / factor
    poses = np.einsum("nji,njk->nik", root, through)
    share = np.einsum("nik,nil->kl", poses, poses)
    return marginal.H - share, share


def solve_symmetric(H: Array, b: Array) -> Array:
    """Return H^-1 b for a positive semi-definite H, scaled first because the unknowns' units differ."""
    d = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled = H * np.outer(d, d)
    return d * np.linalg.lstsq(scaled, d * b, rcond=1e-14)[0]


def inverse_symmetric(H: Array) -> Array:
    """Return H^-1 (pseudo-inverse), scaled first because the unknowns' units differ."""
    d = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.linalg.pinv(H * np.outer(d, d), rcond=1e-14, hermitian=True) * np.outer(d, d)
