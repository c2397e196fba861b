"""Judges hand-held images by their spheres alone, adjusts all of them together, and leads to the wanted places."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.layout.photographs import CALIBRATED, SpherePhotograph, adjust, places_by_size
from service.compute.live import clipped_fraction, expected_spheres, sharpness
from service.compute.markers.cones import Cone, ObservedCones, fit_pose
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import DetectionOptions, SphereOutline
from service.compute.planning.coverage import ViewInformation, view_information
from service.compute.registration.hypotheses import paired
from service.compute.registration.identity import identify_each
from service.compute.registration.problem import EXPECTED_COMMON_ERRORS
from service.compute.scene import ScanSpheres
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, inverse, transform
from service.core.units import deg

_LEAST_SPHERES = 4  # with four, a wrong assignment contradicts itself
_LEAST_SHARE = 0.7  # of the spheres expected in the image; with fewer, something is in front of the lens
_MOST_EDGE_PX = 3.5  # edge width across an outline; a sharp image has about 1.5
_MOST_CLIPPED = 0.05  # of the pixels
_LEAST_BRIGHT = 60.0  # of 255: exceeded by at least a hundredth of the pixels
_ROUGH_M, _ROUGH_SIGMA_M = 0.012, 0.01  # difference between two layouts from photographs
_NO_POSE = (
    "{count} spheres found, which do not determine the camera pose: it may have moved, be out of focus or too near, "
    "or something may be in front of the lens"
)
_POSE_SIGMA_M = 2e-3  # outlines that contradict the image's own pose by more are not spheres of the list


@dataclass(frozen=True, slots=True)
class HandView:
    """The result of looking at one image.

    Attributes:
        T_scene_camera: (4, 4) camera pose in the spheres' frame; None if the spheres do not determine it.
        information: information about the scan's pose relative to the camera; None without a pose.
        why: the reason why the image is unusable; empty if it is good.
        shown: outlines by sphere.
    """

    T_scene_camera: Transform | None
    information: ViewInformation | None = field(repr=False)
    outlines: int
    spheres_seen: int
    spheres_expected: int
    edge_px: float
    rms_px: float
    clipped: float
    why: str
    shown: Mapping[int, SphereOutline] = field(default_factory=dict[int, SphereOutline], repr=False)


def look_at_image(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    spheres_m: Array,
    radius_m: float,
    options: DetectionOptions,
    *,
    rough: bool = False,
) -> HandView:
    """Search a whole image (H, W, 3) for the spheres (M, 3), without a predicted camera pose.

    Args:
        rough: true if the sphere centres come from photographs alone; they and the camera pose are then only good to
            some millimetres.
    """
    outlines = detect_spheres(image_bgr, camera, options)
    quality = sharpness(image_bgr, outlines, camera)
    clipped = clipped_fraction(image_bgr)
    found = _rough_pose(outlines, spheres_m, radius_m) if rough else _read(outlines, camera, spheres_m, radius_m)
    T_camera_scene, markers = pose_by_spheres(found, outlines, camera, spheres_m, radius_m)
    exposure = _exposure(image_bgr, clipped)
    if T_camera_scene is None:
        why = exposure or _NO_POSE.format(count=len(outlines))
        return HandView(None, None, len(outlines), 0, 0, quality.edge_px, quality.rms_px, clipped, why)
    T_scene_camera = inverse(T_camera_scene)
    expected = expected_spheres(T_camera_scene, spheres_m, radius_m, camera)
    information = view_information(
        T_scene_camera,
        np.eye(4),
        outlines,
        markers,
        ScanSpheres(spheres_m, radius_m),
        spheres_m.mean(axis=0),
        _ROUGH_SIGMA_M if rough else _POSE_SIGMA_M,
    )
    return HandView(
        T_scene_camera,
        information,
        len(outlines),
        len(markers),
        len(expected),
        quality.edge_px,
        quality.rms_px,
        clipped,
        exposure or _fault(quality.edge_px, len(markers), len(expected)),
        {sphere: outlines[o] for o, sphere in markers.items()},
    )


def _read(
    outlines: Sequence[SphereOutline], camera: CameraModel, spheres_m: Array, radius_m: float
) -> Transform | None:
    """Return T_camera_scene from the assignment on which the spheres agree; None if there is none."""
    if len(outlines) < _LEAST_SPHERES:
        return None
    try:
        (reading,) = identify_each([outlines], camera, ScanSpheres(spheres_m, radius_m))
    except ComputeError:
        return None
    return reading.T_camera_scan


def _rough_pose(outlines: Sequence[SphereOutline], spheres_m: Array, radius_m: float) -> Transform | None:
    """Find T_camera_scene by matching the spheres' positions in this image with those from other photographs."""
    places = places_by_size([outline.cone for outline in outlines], radius_m)
    if len(places) < _LEAST_SPHERES:
        return None
    try:
        return match_constellations(places, spheres_m, _ROUGH_M).T_a_b
    except ComputeError:
        return None


def pose_by_spheres(
    start: Transform | None,
    outlines: Sequence[SphereOutline],
    camera: CameraModel,
    spheres_m: Array,
    radius_m: float,
) -> tuple[Transform | None, dict[int, int]]:
    """Find T_camera_scene of an image and outline → sphere; None and {} if fewer than four spheres (M, 3) agree."""
    if start is None:
        return None, {}
    markers = paired(outlines, start, spheres_m, radius_m, camera)
    if len(markers) < _LEAST_SPHERES:
        return None, {}
    cones = ObservedCones.of(outlines[o].cone for o in markers)
    pose = fit_pose(cones, spheres_m[list(markers.values())], radius_m, start)
    return pose, paired(outlines, pose, spheres_m, radius_m, camera)


def _fault(edge_px: float, seen: int, expected: int) -> str:
    """Describe what is wrong with an image whose camera pose is known; empty if nothing."""
    if edge_px > _MOST_EDGE_PX:
        return f"blurred: outlines are {edge_px:.1f} px wide; hold the camera still"
    if expected >= _LEAST_SPHERES and seen < _LEAST_SHARE * expected:
        return f"{seen} of {expected} spheres are seen: something is in front of the lens"
    return ""


def _exposure(image_bgr: NDArray[np.uint8], clipped: float) -> str:
    if clipped > _MOST_CLIPPED:
        return f"overexposed: {100 * clipped:.0f} % of the pixels are white"
    bright = float(np.percentile(image_bgr[::4, ::4].max(axis=2), 99))
    return f"underexposed: hardly a pixel is brighter than {bright:.0f} of 255" if bright < _LEAST_BRIGHT else ""


def poses_by_spheres(
    outlines: Sequence[Sequence[SphereOutline]], names: Sequence[str], camera: CameraModel, spheres: ScanSpheres
) -> dict[str, Transform]:
    """Compute T_scan_camera, (4, 4), of every image whose spheres determine it, by its name; each from its own image.

    Args:
        outlines: the outlines of N images, each searched whole.
        names: the names of the N images.
        camera: the camera of the images.
        spheres: the registration spheres.

    Raises:
        ComputeError: no image shows four of the spheres in their arrangement.
    """
    found: dict[str, Transform] = {}
    for name, mine, assigned in zip(names, outlines, identify_each(outlines, camera, spheres), strict=True):
        pose, _ = pose_by_spheres(assigned.T_camera_scan, mine, camera, spheres.centres_m, spheres.radius_m)
        if pose is not None:
            found[name] = inverse(pose)
    return found


_WORST_CHI2 = 20.0  # per degree of freedom: above it, the spheres of some image were mixed up


@dataclass(frozen=True, slots=True)
class ImageReading:
    """One image's contribution: n outlines with their spheres' numbers, and the camera pose from this image alone."""

    viewpoint: str
    T_scene_camera: Transform
    spheres: NDArray[np.int64]  # (n,)
    axes: Array  # (n, 3)
    half_angles_rad: Array  # (n,)
    covariances: Array  # (n, 3, 3), as SphereOutline.cone_covariance

    @classmethod
    def of(cls, viewpoint: str, T_scene_camera: Transform, shown: Mapping[int, SphereOutline]) -> ImageReading:
        """Build the reading from an image's outlines by sphere."""
        outlines = list(shown.values())
        return cls(
            viewpoint,
            T_scene_camera,
            np.array(list(shown), dtype=np.int64),
            np.array([o.cone.axis for o in outlines]).reshape(-1, 3),
            np.array([o.cone.half_angle_rad for o in outlines]),
            np.array([o.cone_covariance for o in outlines]).reshape(-1, 3, 3),
        )

    def of_spheres(self, numbers: NDArray[np.int64]) -> ImageReading:
        """Return the reading with these spheres only."""
        kept = np.isin(self.spheres, numbers)
        return replace(
            self,
            spheres=self.spheres[kept],
            axes=self.axes[kept],
            half_angles_rad=self.half_angles_rad[kept],
            covariances=self.covariances[kept],
        )

    def record(self) -> dict[str, Any]:
        """Return the reading as plain data, as `read` takes it."""
        return {
            "spheres": self.spheres.tolist(),
            "axes": self.axes.tolist(),
            "half_angles_rad": self.half_angles_rad.tolist(),
            "covariances": self.covariances.tolist(),
        }

    @classmethod
    def read(cls, viewpoint: str, T_scene_camera: Transform, data: Mapping[str, Any]) -> ImageReading:
        """Read plain data written by `record`."""
        return cls(
            viewpoint,
            T_scene_camera,
            np.array(data["spheres"], dtype=np.int64),
            np.array(data["axes"]).reshape(-1, 3),
            np.array(data["half_angles_rad"]),
            np.array(data["covariances"]).reshape(-1, 3, 3),
        )

    def photograph(self, camera: CameraModel) -> SpherePhotograph:
        """Return the reading as input of the adjustment."""
        cones = tuple(Cone(axis, float(half)) for axis, half in zip(self.axes, self.half_angles_rad, strict=True))
        return SpherePhotograph(camera, cones, self.covariances)


@dataclass(frozen=True, slots=True)
class AdjustedCapture:
    """The adjusted spheres and poses.

    Attributes:
        spheres_m: (N, 3) centres in the frame in which they were given; a sphere seen in fewer than two images is
            unchanged.
        known: numbers of the spheres seen in at least two images.
        sigma_m: standard deviation of the least certain of these against the others.
        poses: T_scene_camera by viewpoint.
    """

    spheres_m: Array
    known: NDArray[np.int64]
    sigma_m: float
    poses: Mapping[str, Transform]


def adjust_together(
    readings: Sequence[ImageReading], spheres_m: Array, camera: CameraModel, radius_m: float
) -> AdjustedCapture | None:
    """Refine spheres (N, 3) and cameras from the outlines of all images.

    Spheres seen in only one image take no part, because one image determines their distance poorly. None if fewer
    than two images show four of the others, or if the images do not fit together.
    """
    counts = np.zeros(len(spheres_m), dtype=np.int64)
    for reading in readings:
        counts[reading.spheres] += 1
    shared = np.nonzero(counts >= 2)[0]
    number = np.full(len(spheres_m), -1, dtype=np.int64)
    number[shared] = np.arange(len(shared))
    joined = [r.of_spheres(shared) for r in readings]
    joined = [r for r in joined if len(r.spheres) >= _LEAST_SPHERES]
    if len(joined) < 2 or len(np.unique(np.concatenate([r.spheres for r in joined]))) < len(shared):
        return None
    first = joined[0].T_scene_camera
    try:
        found = adjust(
            [r.photograph(camera) for r in joined],
            [number[r.spheres] for r in joined],
            apply(inverse(first), spheres_m[shared]),
            [inverse(r.T_scene_camera) @ first for r in joined],
            radius_m,
            CALIBRATED,
        )
    except ComputeError:
        return None
    if found.chi2 > _WORST_CHI2:
        return None
    T_scene_first, _ = align_points(spheres_m[shared], found.centres_m)
    refined = spheres_m.copy()
    refined[shared] = apply(T_scene_first, found.centres_m)
    poses = {r.viewpoint: T_scene_first @ inverse(T) for r, T in zip(joined, found.T_photo_first, strict=True)}
    halves = np.concatenate([r.half_angles_rad for r in joined])
    scale_sigma = EXPECTED_COMMON_ERRORS.growth_px / (camera.fx * float(np.tan(np.median(halves))))
    return AdjustedCapture(refined, shared, _worst_sigma_m(found.centres_m, found.covariance, scale_sigma), poses)


def _worst_sigma_m(centres_m: Array, covariance: Array, scale_sigma: float) -> float:
    """Return the worst standard deviation of the shape alone, without position and rotation of the whole.

    The spheres' radius is the only length in the images, so outlines that are all too wide make the whole too small.
    """
    away = centres_m - centres_m.mean(axis=0)
    turns = np.stack([np.cross(axis, away).ravel() for axis in np.eye(3)], axis=1)
    free, _ = np.linalg.qr(np.hstack([np.tile(np.eye(3), (len(away), 1)), turns]))
    shape = np.eye(len(free)) - free @ free.T
    own = (shape @ covariance @ shape.T).reshape(len(away), 3, len(away), 3)
    of_scale = scale_sigma**2 * np.sum(away**2, axis=1)
    return float(np.sqrt((np.einsum("ijij->i", own) + of_scale).max()))


# Guides a hand-held camera: the wanted places, and the text that leads from the current one to them.
#
# The level frame is in the middle of the scene: z up, y in the direction in which the first image's top pointed, so
# that the person stood at −y. A camera's attitude is `turn` about z, `lean` of its right side down and `tilt` of
# its axis down from the horizon: R = Rz(turn) Ry(lean) Rx(−tilt) C0, where C0 looks along y with its top up. This
# is singular only if the camera's side points up, not if it looks straight down.


_FORWARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # C0: columns are x, y, z of the camera
_COARSE_FROM_M = 0.10  # distances above are given in steps of five centimetres, below in steps of one
_ANGLE_STEP_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Attitude:
    """A camera's orientation in the level frame, radians; see the module's docstring."""

    turn_rad: float
    lean_rad: float
    tilt_rad: float

    @classmethod
    def of(cls, R_level_camera: Array) -> Attitude:
        """Return the attitude of a rotation matrix R_level_camera (3, 3)."""
        x, z = R_level_camera[:, 0], R_level_camera[:, 2]
        turn, lean = float(np.arctan2(x[1], x[0])), float(np.arcsin(np.clip(-x[2], -1.0, 1.0)))
        ahead = (Rotation.from_euler("z", turn) * Rotation.from_euler("y", lean)).inv().apply(z)
        return cls(turn, lean, float(np.arctan2(-ahead[2], ahead[1])))

    def matrix(self) -> Array:
        """Return (3, 3) R_level_camera."""
        turned = Rotation.from_euler("z", self.turn_rad) * Rotation.from_euler("y", self.lean_rad)
        return np.asarray((turned * Rotation.from_euler("x", -self.tilt_rad)).as_matrix() @ _FORWARD)


@dataclass(frozen=True, slots=True)
class WantedView:
    """A wanted view: the camera pose in the level frame."""

    name: str
    T_level_camera: Transform
    aim_m: Array  # (3,) point that the camera looks at


def level_frame(centre_m: Array, up: Array, top: Array) -> Transform:
    """Return T_scene_level: origin at `centre_m` (3,), z along `up` (3,), y along the level part of `top` (3,)."""
    z = up / np.linalg.norm(up)
    y = top - z * (top @ z)
    if np.linalg.norm(y) < 1e-6:
        y = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    y = y / np.linalg.norm(y)
    return transform(np.column_stack([np.cross(y, z), y, z]), np.asarray(centre_m, dtype=np.float64))


def away_from_plane(spheres_m: Array, eye_m: Array) -> Array:
    """Return the normal (3,) of the best plane through the spheres (M, 3), towards the camera at `eye_m` (3,)."""
    middle = spheres_m.mean(axis=0)
    normal = np.linalg.svd(spheres_m - middle)[2][2]
    return np.asarray(normal if (eye_m - middle) @ normal > 0 else -normal, dtype=np.float64)


def place_at(
    name: str, *, tilt_deg: float, azimuth_deg: float, distance_m: float, walk_round: bool, aim_m: Sequence[float]
) -> WantedView:
    """Compute a place on the hemisphere around the scene.

    Args:
        tilt_deg: angle of the line of sight from the vertical.
        azimuth_deg: 0 is the person's side, positive to the person's right.
        distance_m: distance from `aim_m`.
        walk_round: true if the person walks round the scene and the top of the image points away from the person;
            otherwise it stays as in the first image.
        aim_m: (3,) point that the camera looks at, level frame.
    """
    tilt, azimuth = np.deg2rad(tilt_deg), np.deg2rad(azimuth_deg)
    aim, out = np.asarray(aim_m, dtype=np.float64), np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    axis = -(np.cos(tilt) * np.array([0.0, 0.0, 1.0]) + np.sin(tilt) * out)
    top = -out if walk_round else np.array([0.0, 1.0, 0.0])
    right = np.cross(axis, top)
    right /= np.linalg.norm(right)
    return WantedView(
        name, transform(np.column_stack([right, np.cross(axis, right), axis]), aim - distance_m * axis), aim
    )


def words(T_level_here: Transform, T_level_there: Transform) -> str:
    """Return a text such as `20 cm to the left, 10 cm lower, tilt 15° down` from one camera pose (4, 4) to another.

    Both poses are in the level frame. Left, right, forward and back are those of a holder who looks in the direction
    of the image's top; the camera is first moved, then turned. Empty if there is nothing to change.
    """
    here, there = Attitude.of(T_level_here[:3, :3]), Attitude.of(T_level_there[:3, :3])
    moved = Rotation.from_euler("z", -here.turn_rad).apply(T_level_there[:3, 3] - T_level_here[:3, 3])
    parts = [
        _distance(float(moved[0]), "to the right", "to the left"),
        _distance(float(moved[1]), "forward", "back"),
        _distance(float(moved[2]), "higher", "lower"),
        _angle(there.turn_rad - here.turn_rad, "turn", "to the left", "to the right"),
        _angle(there.tilt_rad - here.tilt_rad, "tilt", "down", "up"),
        _angle(there.lean_rad - here.lean_rad, "lean", "to the right", "to the left"),
    ]
    return ", ".join(part for part in parts if part)


def _distance(metres: float, positive: str, negative: str) -> str:
    step_cm = 5 if abs(metres) >= _COARSE_FROM_M else 1
    centimetres = step_cm * round(100 * abs(metres) / step_cm)
    return f"{centimetres} cm {positive if metres > 0 else negative}" if centimetres else ""


def _angle(radians: float, verb: str, positive: str, negative: str) -> str:
    degrees = deg((radians + np.pi) % (2 * np.pi) - np.pi)
    told = int(_ANGLE_STEP_DEG * round(abs(degrees) / _ANGLE_STEP_DEG))
    return f"{verb} {told}° {positive if degrees > 0 else negative}" if told else ""


def covered(places: Iterable[WantedView], T_level_cameras: Sequence[Transform], within_deg: float) -> set[str]:
    """Return the names of the places that an image covers: position and axis agree within `within_deg`."""
    limit = np.cos(np.deg2rad(within_deg))
    done: set[str] = set()
    for place in places:
        from_aim = place.T_level_camera[:3, 3] - place.aim_m
        for T in T_level_cameras:
            away = T[:3, 3] - place.aim_m
            cosine = (from_aim @ away) / (np.linalg.norm(from_aim) * np.linalg.norm(away))
            if min(cosine, place.T_level_camera[:3, 2] @ T[:3, 2]) >= limit:
                done.add(place.name)
                break
    return done


def nearest(places: Iterable[WantedView], T_level_here: Transform) -> WantedView:
    """Return the place nearest to here, a radian of rotation counting as 40 cm. `places` is not empty."""

    def way(place: WantedView) -> float:
        moved = float(np.linalg.norm(place.T_level_camera[:3, 3] - T_level_here[:3, 3]))
        turned = Rotation.from_matrix(T_level_here[:3, :3].T @ place.T_level_camera[:3, :3]).magnitude()
        return moved + 0.4 * float(turned)

    return min(places, key=lambda place: (round(way(place), 3), place.name))


def same_view(T_a: Transform, T_b: Transform, apart_m: float, apart_rad: float) -> bool:
    """Return whether two camera poses in one frame are so near that the second image adds nothing."""
    T = inverse(T_a) @ T_b
    return bool(np.linalg.norm(T[:3, 3]) < apart_m and Rotation.from_matrix(T[:3, :3]).magnitude() < apart_rad)
