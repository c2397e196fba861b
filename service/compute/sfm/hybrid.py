"""Estimates hybrid camera poses: tracks, robot poses and measured spheres in one bundle adjustment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraCovariance, CameraModel
from service.compute.markers.cones import Cone, ObservedCones
from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import identify
from service.compute.registration.problem import EXPECTED_COMMON_ERRORS, CommonErrors, RegistrationSettings
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.sfm.adjustment import BundleSolution, solve
from service.compute.sfm.bundle import (
    AdjustmentData,
    BundleState,
    Sigmas,
    SphereSightings,
    linearise,
    normal_equations,
    whitening_of,
)
from service.compute.sfm.features import Tracks
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse, skew, transform

_RIM = 12  # rays of an outline that are recomputed


def camera_share(solution: BundleSolution, data: AdjustmentData, known: CameraCovariance) -> Array:
    """Return the covariance (n, n) of the frame parameters due to the camera's, to be added to the solution's.

    For each deviation of the camera, this takes the step that the adjustment would make with that camera: robust
    weights fixed, points adjusted, cones recomputed from the outlines' pixels.
    """
    plain = linearise(solution.state, data, solution.sigmas)
    weighted = {name: rows.weighted(solution.weights[name]) for name, rows in plain.items()}
    total = np.zeros_like(solution.covariance)
    for camera in known.deviations(solution.state.camera):
        again = dataclasses.replace(data, sightings=_read_by(data.sightings, solution.state.camera, camera))
        other = linearise(dataclasses.replace(solution.state, camera=camera), again, solution.sigmas)
        changed = [
            dataclasses.replace(
                weighted[name],
                residual=np.repeat(np.sqrt(solution.weights[name]), plain[name].size)
                * (other[name].residual - plain[name].residual),
            )
            for name in plain
        ]
        step = normal_equations(changed).step(0.0)[0]
        total += np.outer(step, step)
    return total


def _read_by(sightings: SphereSightings | None, held: CameraModel, other: CameraModel) -> SphereSightings | None:
    """Compute the outlines' cones again from the same pixels with another camera model."""
    if sightings is None:
        return None
    azimuth = np.linspace(0.0, 2 * np.pi, _RIM, endpoint=False)
    seen = sightings.cones
    axes, halves = seen.axes.copy(), seen.half_angles.copy()
    for i, (axis, half) in enumerate(zip(seen.axes, seen.half_angles, strict=True)):
        cone = Cone(axis, float(half))
        pixels = held.project(np.vstack([axis, cone.rays(azimuth, np.full(_RIM, half))]))
        rays = np.column_stack([other.normalise(pixels), np.ones(_RIM + 1)])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        axes[i] = rays[0]
        halves[i] = float(np.mean(np.arccos(np.clip(rays[1:] @ rays[0], -1, 1))))
    return dataclasses.replace(sightings, cones=dataclasses.replace(seen, axes=axes, half_angles=halves))


# Structure from motion gives the cameras' relative poses to hundredths of a millimetre but no scale; the spheres
# give the scale and the scan's frame; the robot gives each station's base. One adjustment weights all three by
# variance components estimated from the data.


@dataclass(frozen=True, slots=True)
class HybridOptions:
    """Settings of the adjustment.

    Attributes:
        sphere_sigma_m: standard deviation per coordinate of a sphere's position in the scan, used if no covariance is
            given.
        common_errors: prior sizes of the errors that all outlines share, which are estimated; None:
            `EXPECTED_COMMON_ERRORS`.
        most_observations: largest number of observations of tracks used; more gain almost nothing and cost time and
            memory.
        robot_sigma_m: initial sigma of the robot's positions; estimated from the data.
        robot_sigma_rad: initial sigma of its orientations; estimated from the data.
        track_sigma_px: initial sigma of the tracks; estimated from the data.
        lens_covariance: (4, 4) covariance of the calibrated fx, fy, cx, cy, to refine them with the calibration as a
            prior; None: the camera is fixed.
    """

    sphere_sigma_m: float = 5e-6
    common_errors: CommonErrors | None = None
    most_observations: int = 200_000
    robot_sigma_m: float = 1e-3
    robot_sigma_rad: float = 2e-3
    track_sigma_px: float = 0.4
    lens_covariance: Array | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class HybridPoses:
    """Metric camera poses with their covariance and diagnostics.

    World is the base frame of the first group, or the scan frame if no robot pose was given. Increments (d, w) of
    covariances are exp(w) R, t + d in the axes of the outer frame, metres and radians.

    Attributes:
        T_scan_camera: (N, 4, 4) camera poses in the scan frame.
        T_world_camera: (N, 4, 4) camera poses in the world frame.
        T_world_scan: the registration.
        T_world_group: the base of each group.
        points_scan: (P, 3) scene points used.
        covariance: (6 (N + G), 6 (N + G)) joint, of every image's T_scan_camera, then of every group's T_scan_base.
        camera_share: part of it due to the camera's own uncertainty; zero if that was not given.
        camera: the camera as given, or refined.
        sigma_track_px: standard deviation of one observation of a track.
        sphere_factor: ratio of the outlines' residuals to their own sigmas.
        sigma_robot_m, sigma_robot_rad: standard deviations of the robot's poses per axis, including systematic
            errors; None without a robot.
        chi2: reduced chi square of each component: tracks, spheres, centres, robot_position, robot_rotation, lens.
        registration: the registration of the scan to the poses of structure from motion, from which the adjustment
            started.
        centre_scan_m: (3,) mean of the spheres' centres.
    """

    T_scan_camera: Array
    T_world_camera: Array
    T_world_scan: Transform
    T_world_group: dict[int, Transform]
    points_scan: Array = field(repr=False)
    covariance: Array = field(repr=False)
    camera_share: Array = field(repr=False)
    camera: CameraModel
    sigma_track_px: float
    sphere_factor: float
    sigma_robot_m: float | None
    sigma_robot_rad: float | None
    chi2: dict[str, float]
    registration: RegistrationResult = field(repr=False)
    centre_scan_m: Array

    @property
    def scan_pose_covariance(self) -> Array:
        """(N, 6, 6) of T_scan_camera in the scan's axes: how well each image is placed relative to the scan."""
        n = len(self.T_scan_camera)
        return np.array([self.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(n)])

    @property
    def pose_covariance(self) -> Array:
        """(N, 6, 6) of T_world_camera in world axes; includes the robot's noise, which is common to all images."""
        joint = self.joint_world_covariance()
        return np.array([joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(self.T_world_camera))])

    def joint_world_covariance(self) -> Array:
        """Return (6 N + 6, 6 N + 6) of every image's T_world_camera and, last, of T_world_scan."""
        n = len(self.T_scan_camera)
        J = np.zeros((6 * n + 6, len(self.covariance)))
        R = self.T_world_scan[:3, :3]
        if not self.T_world_group:
            J[: 6 * n, : 6 * n] = np.eye(6 * n)
            return J @ self.covariance @ J.T
        base = slice(6 * n, 6 * n + 6)
        t_base = inverse(self.T_world_scan)[:3, 3]
        for i in range(n):
            rows = slice(6 * i, 6 * i + 6)
            J[rows, rows] = _block(R, R)
            J[rows, base] = _relative(R, self.T_scan_camera[i, :3, 3] - t_base)
        J[6 * n :, base] = _relative(R, -t_base)
        return J @ self.covariance @ J.T

    @property
    def scan_covariance(self) -> Array:
        """Return the covariance (6, 6) of T_world_scan; it is zero if the world is the scan frame."""
        return self.joint_world_covariance()[-6:, -6:]

    def sigma_at_m(self, point_scan_m: Array) -> float:
        """Return the predicted target registration error at a point (3,) of the scan: 3D standard deviation, metres.

        For the set of images as a whole, aligned to the true one by its camera positions: errors of single images
        average out, common errors remain.
        """
        n = len(self.T_scan_camera)
        v = point_scan_m - self.T_scan_camera[:, :3, 3]
        centred = self.T_scan_camera[:, :3, 3] - self.T_scan_camera[:, :3, 3].mean(axis=0)
        inertia = np.sum(centred**2) * np.eye(3) - centred.T @ centred
        # Rigid fit of the displaced positions: mean displacement, and rotation I^-1 sum r x d.
        arm = point_scan_m - self.T_scan_camera[:, :3, 3].mean(axis=0)
        J = np.zeros((3, len(self.covariance)))
        for i in range(len(v)):
            turn = np.linalg.solve(inertia, skew(centred[i]))
            J[:, 6 * i : 6 * i + 3] = np.eye(3) / n - skew(arm) @ turn
        return float(np.sqrt(np.trace(J @ self.covariance @ J.T)))


def hybrid_poses(
    images: PosedImages,
    tracks: Tracks,
    outlines: Sequence[Sequence[SphereOutline]],
    spheres: ScanSpheres,
    *,
    T_base_camera: Array | None = None,
    known_camera: CameraCovariance | None = None,
    options: HybridOptions | None = None,
) -> HybridPoses:
    """Adjust tracks, spheres and robot poses together.

    Args:
        images: the images with poses from structure from motion, in any frame and scale, and the camera by which the
            outlines were made. Their stations are those of the robot.
        tracks: tracks of the same model.
        outlines: the detector's outlines of each image.
        spheres: the registration spheres; without a covariance, options.sphere_sigma_m.
        T_base_camera: (N, 4, 4) poses by the robot and the hand-eye calibration, each in its station's base frame;
            NaN for images without a robot pose. None: only the spheres give the metric frame.
        known_camera: covariance of a fixed camera, which is propagated to the poses. None: taken as exact.
        options: settings.

    Raises:
        DataError: lengths do not agree.
        ComputeError: the spheres cannot be identified, the registration fails, or the adjustment is undetermined.
    """
    settings = options or HybridOptions()
    n, stations = len(images.poses), images.stations
    if len(outlines) != n or len(stations) != n or (T_base_camera is not None and T_base_camera.shape != (n, 4, 4)):
        raise DataError(f"{n} camera poses, but {len(outlines)} images' outlines and {len(stations)} stations")
    # Structure from motion has one frame for all stations, and no scale.
    one = dataclasses.replace(images, groups=None, metric=False)
    assignments = identify(outlines, one, spheres)
    # Only for initial values and to find wrong outlines: the adjustment itself models the errors of the poses.
    start = register(
        outlines,
        assignments,
        one,
        dataclasses.replace(spheres, covariance_m2=None),
        RegistrationSettings(pose_covariance="exact"),
    )
    used = tracks.thinned(settings.most_observations)
    bases, order, group = _bases(start.T_scan_camera, T_base_camera, stations)
    state = BundleState(
        cameras=start.T_scan_camera,
        points=np.vstack([apply(inverse(start.T_world_scan), start.scale * used.points), spheres.centres_m]),
        bases=bases,
        camera=images.camera,
    )
    data = _data(used, _sightings(outlines, start), spheres, images.camera, settings)
    if order:
        data = dataclasses.replace(data, robot=T_base_camera, group=group)
    sigmas = Sigmas(settings.track_sigma_px, 1.0, settings.robot_sigma_m, settings.robot_sigma_rad)
    solution = solve(state, data, sigmas)
    share = np.zeros_like(solution.covariance)
    if known_camera is not None and settings.lens_covariance is None:
        share = camera_share(solution, data, known_camera)
    return _answer(solution, share, order, len(used.points), start)


def _data(
    tracks: Tracks, sightings: SphereSightings, spheres: ScanSpheres, camera: CameraModel, settings: HybridOptions
) -> AdjustmentData:
    """Return the measurements of tracks and spheres, with their priors."""
    common = settings.common_errors or EXPECTED_COMMON_ERRORS
    covariance = spheres.covariance_m2
    if covariance is None:
        covariance = np.broadcast_to(settings.sphere_sigma_m**2 * np.eye(3), (len(spheres.centres_m), 3, 3))
    distance_m = float(np.mean(spheres.radius_m / np.sin(sightings.cones.half_angles)))
    return AdjustmentData(
        tracks=tracks,
        sightings=sightings,
        centres=spheres.centres_m,
        centre_whitening=whitening_of(covariance),
        common_sigma_px=np.repeat([common.shift_px, common.growth_px, common.light_px], [2, 1, 3]),
        light_unit_m=distance_m / (0.5 * (camera.fx + camera.fy)),
        radius_m=spheres.radius_m,
        calibrated=camera,
        lens_covariance=settings.lens_covariance,
    )


def _answer(
    solution: BundleSolution, share: Array, order: list[int], n_points: int, start: RegistrationResult
) -> HybridPoses:
    state, n = solution.state, len(solution.state.cameras)
    T_world_scan = inverse(state.bases[0]) if order else np.eye(4)
    size = 6 * (n + len(order))
    return HybridPoses(
        T_scan_camera=state.cameras,
        T_world_camera=T_world_scan @ state.cameras,
        T_world_scan=T_world_scan,
        T_world_group={g: T_world_scan @ state.bases[k] for k, g in enumerate(order)},
        points_scan=state.points[:n_points],
        covariance=(solution.covariance + share)[:size, :size],
        camera_share=share[:size, :size],
        camera=state.camera,
        sigma_track_px=solution.sigmas.track_px,
        sphere_factor=solution.sigmas.sphere,
        sigma_robot_m=solution.sigmas.robot_m if order else None,
        sigma_robot_rad=solution.sigmas.robot_rad if order else None,
        chi2=solution.chi2,
        registration=start,
        centre_scan_m=state.points[n_points:].mean(axis=0),
    )


def _sightings(outlines: Sequence[Sequence[SphereOutline]], start: RegistrationResult) -> SphereSightings:
    """Return the outlines that the registration used; a marker that it never used keeps its position in the scan."""
    used = [r for r in start.residuals if not r.excluded]
    found = [outlines[r.image][r.outline] for r in used]
    whitening = whitening_of(np.array([o.cone_covariance for o in found]))
    return SphereSightings(
        image=np.array([r.image for r in used]),
        marker=np.array([r.marker for r in used]),
        cones=ObservedCones.of(o.cone for o in found),
        whitening=whitening,
    )


def _bases(
    T_scan_camera: Array, T_base_camera: Array | None, stations: NDArray[np.int64]
) -> tuple[Array, list[int], NDArray[np.int64]]:
    """Return the initial T_scan_base (G, 4, 4), the groups in order, and each image's index among them."""
    if T_base_camera is None:
        return np.empty((0, 4, 4)), [], np.zeros(len(stations), dtype=np.int64)
    known = np.isfinite(T_base_camera).all(axis=(1, 2))
    first = int(stations[0])
    order = sorted({int(g) for g in stations[known]}, key=lambda g: (g != first, g))
    bases: list[Transform] = []
    for g in order:
        mine = np.nonzero(known & (stations == g))[0]
        if len(mine) < 2:
            raise ComputeError(f"station {g} has {len(mine)} images with a robot pose; two are needed")
        T = np.array([T_scan_camera[i] @ inverse(T_base_camera[i]) for i in mine])
        R = Rotation.from_matrix(T[:, :3, :3]).mean()
        lever = np.array([T_scan_camera[i, :3, 3] - R.apply(T_base_camera[i, :3, 3]) for i in mine])
        bases.append(transform(R, np.median(lever, axis=0)))
    group = np.array([order.index(int(g)) if int(g) in order else 0 for g in stations], dtype=np.int64)
    return np.array(bases), order, group


def _block(a: Array, b: Array) -> Array:
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = a, b
    return out


def _relative(R_world_scan: Array, lever_scan: Array) -> Array:
    """Return (6, 6) derivative of T_world_x = T_scan_base^-1 T_scan_x by T_scan_base; lever: from base to x."""
    out = _block(-R_world_scan, -R_world_scan)
    out[:3, 3:] = R_world_scan @ skew(lever_scan)
    return out
