"""Finds inputs that contradict the others, says what to do about each, and finds errors that all outlines share."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from service.compute.markers.predicted import CLEARLY_VISIBLE, visible_cones
from service.compute.markers.records import SphereOutline
from service.compute.markers.refine import SYSTEMATIC_PER_BLUR
from service.compute.registration.control_spheres import WINDOW_M, SearchNearby, evaluate_controls
from service.compute.registration.hypotheses import image_hypotheses, rivals
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import CommonErrors, RegistrationSettings
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, inverse, rotation_angle_rad
from service.core.units import mm
from service.core.words import counted

ContradictionKind = Literal[
    "image left out", "images contradict", "sphere not found", "spheres not found", "focal length",
    "principal point", "scale", "size of outlines", "blur",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A fault that the outlines show in the inputs of a registration.

    Attributes:
        kind: the kind of fault.
        what: is wrong, in a sentence without its full stop.
        remedy: advice to the user; where the data cannot distinguish causes, advice for each.
        refuses: true if the result must not be used before somebody has looked at this.
    """

    kind: ContradictionKind
    what: str
    remedy: str
    refuses: bool = False


MOST_LEFT_OUT = 0.25  # share of the images: if more contradict one another, nothing shows which are wrong
_TIMES_TYPICAL, _LEAST_PX = 5.0, 1.0  # of the other images' distance from the prediction
_LEAST_SEEN, _SEEN_SHARE = 4, 0.3  # spheres that must be expected, and share of them that must be used
_SAME_PLACE_M, _SAME_TURN_RAD = 5e-3, np.radians(1.0)  # of poses that are taken as one
_NAMED = 6  # images in one sentence


def odd_images(
    outlines: Sequence[Sequence[SphereOutline]],
    images: PosedImages,
    spheres: ScanSpheres,
    registration: RegistrationResult,
) -> frozenset[int]:
    """Find the images that contradict a registration of all of them.

    Args:
        outlines: all outlines that were found in each image.
        images: the images with the poses as given.
        spheres: the registration spheres.
        registration: the registration of all images.
    """
    gaps = _gaps(registration)
    typical_px = float(np.median(list(gaps.values()))) if gaps else 0.0
    far = {i for i, gap in gaps.items() if gap > max(_TIMES_TYPICAL * typical_px, _LEAST_PX)}
    blind = {i for i in range(len(outlines)) if _misses_most(i, images, spheres, registration)}
    return frozenset(far | blind)


def too_many(odd: Collection[int], images: PosedImages) -> Contradiction | None:
    """Report that so many images contradict one another that none can be left out; None if they are few."""
    n = len(images.poses)
    if len(odd) <= MOST_LEFT_OUT * n:
        return None
    named = ", ".join(images.labels[i] for i in sorted(odd)[:_NAMED]) + (" and others" if len(odd) > _NAMED else "")
    what = f"{len(odd)} of {n} images contradict the others ({named}), too many to leave them out"
    remedy = "Check that images and poses belong together, and that both are of this scan's scene"
    return Contradiction("images contradict", what, remedy, refuses=True)


def describe_left_out(
    left_out: Collection[int],
    outlines: Sequence[Sequence[SphereOutline]],
    images: PosedImages,
    spheres: ScanSpheres,
    registration: RegistrationResult,
) -> dict[int, Contradiction]:
    """Describe what is wrong with each image that was left out of a registration, by its index."""
    own = {i: _own_pose(outlines[i], images, spheres) for i in sorted(left_out)}
    return {i: _finding(i, own, outlines, images, registration) for i in own}


def _gaps(registration: RegistrationResult) -> dict[int, float]:
    """Return the median distance (px) of each image's outlines from those predicted with its pose as given."""
    by_image: dict[int, list[float]] = {}
    for r in registration.residuals:
        by_image.setdefault(r.image, []).append(r.rms_px)
    return {i: float(np.median(gaps)) for i, gaps in by_image.items()}


def _misses_most(i: int, images: PosedImages, spheres: ScanSpheres, registration: RegistrationResult) -> bool:
    """Return whether an image shows hardly one of the spheres where its pose says they are."""
    T = registration.T_scan_camera[i]
    if not np.isfinite(T).all():
        return False
    shown = visible_cones(inverse(T), spheres.centres_m, spheres.radius_m, images.camera, least=CLEARLY_VISIBLE)
    used = sum(r.image == i and not r.excluded for r in registration.residuals)
    return len(shown) >= _LEAST_SEEN and used < _SEEN_SHARE * len(shown)


def _own_pose(found: Sequence[SphereOutline], images: PosedImages, spheres: ScanSpheres) -> Transform | None:
    """Return T_scan_camera by an image's own spheres; None if they do not determine it."""
    readings = image_hypotheses(found, spheres.centres_m, spheres.radius_m, images.camera)
    if not readings or rivals(readings):
        return None
    return inverse(readings[0].T_camera_scan)


def _finding(
    i: int,
    own: dict[int, Transform | None],
    outlines: Sequence[Sequence[SphereOutline]],
    images: PosedImages,
    registration: RegistrationResult,
) -> Contradiction:
    label, mine, given = images.labels[i], own[i], registration.T_scan_camera
    if mine is None:
        what = f"{label} is left out: "
        if len(outlines[i]) >= _LEAST_SEEN:
            what += f"the {len(outlines[i])} spheres that it shows are not in the arrangement of the list"
            remedy = "Check that it is an image of this scene, taken before anything was moved"
        else:
            what += f"{len(outlines[i])} spheres were found in it, far fewer than its pose lets it show"
            remedy = "Check that it is an image of this scene, and that its pose is its own"
        return Contradiction("image left out", what, remedy)
    partner = _with_pose(mine, given, i)
    if partner is not None:
        theirs = own.get(partner)
        mutual = theirs is not None and _with_pose(theirs, given, partner) == i
        other = images.labels[partner]
        what = f"{label} is left out: its spheres fit the pose of {other}"
        what += f", and those of {other} fit its pose: the two are exchanged" if mutual else ""
        return Contradiction("image left out", what, "Correct the names of the images, or the order of the poses")
    off_mm = mm(float(np.linalg.norm(mine[:3, 3] - given[i][:3, 3])))
    turned = np.degrees(rotation_angle_rad(mine[:3, :3].T @ given[i][:3, :3]))
    typical_px = float(np.median(list(_gaps(registration).values())))
    what = (
        f"{label} is left out: its pose is {off_mm:.1f} mm and {turned:.2f}° from where its own spheres put it; the "
        f"other images agree with theirs within {typical_px:.2f} px"
    )
    return Contradiction("image left out", what, "Check the pose of this image; the camera or the arm may have moved")


def _with_pose(mine: Transform, given: Array, i: int) -> int | None:
    """Return the other image whose given pose this is."""
    for k, T in enumerate(given):
        if k == i or not np.isfinite(T).all():
            continue
        apart = float(np.linalg.norm(mine[:3, 3] - T[:3, 3]))
        if apart < _SAME_PLACE_M and rotation_angle_rad(mine[:3, :3].T @ T[:3, :3]) < _SAME_TURN_RAD:
            return k
    return None


_LEAST_IMAGES, _USED_SHARE = 2, 0.3  # that should show a sphere, and share of them whose outline must be used
_MOST_LACKING = 0.3  # share of the spheres: if more are not found, the list is doubtful
_MIRRORED_GAIN = 1.3  # outlines that the mirrored list explains, over those that the list does
_COMPARED = 8  # images in which the list is compared with the mirrored one


def odd_spheres(
    outlines: Sequence[Sequence[SphereOutline]],
    images: PosedImages,
    spheres: ScanSpheres,
    registration: RegistrationResult,
    search: SearchNearby | None,
) -> tuple[Contradiction, ...]:
    """Find spheres of the list that hardly any image shows where it is, and where they are, if the images show that.

    Raises:
        ComputeError: most are not found, and the mirrored list explains the images better.
    """
    posed = [i for i, T in enumerate(registration.T_scan_camera) if np.isfinite(T).all()]
    registered = replace(images, poses=registration.T_scan_camera)
    shown = {
        i: visible_cones(
            inverse(registered.poses[i]), spheres.centres_m, spheres.radius_m, images.camera, least=CLEARLY_VISIBLE
        )
        for i in posed
    }
    used: dict[int, int] = {}
    for r in registration.residuals:
        used[r.marker] = used.get(r.marker, 0) + (not r.excluded)
    expected = {m: sum(m in mine for mine in shown.values()) for m in range(len(spheres.centres_m))}
    odd = [m for m, n in expected.items() if n >= _LEAST_IMAGES and used.get(m, 0) < _USED_SHARE * n]
    if not odd:
        return ()
    if len(odd) > _MOST_LACKING * len(expected):
        require_handedness(outlines, images, spheres)
    taken = [Assignment() for _ in outlines]
    for r in registration.residuals:
        if not r.excluded and r.marker not in odd:
            taken[r.image].markers[r.outline] = r.marker
    rest = [m for m in expected if m not in odd]
    listed = ScanSpheres(spheres.centres_m[rest], spheres.radius_m, control_m=spheres.centres_m[odd])
    sought = evaluate_controls(outlines, taken, registered, listed, search=search)
    found = {odd[s.index]: s for s in sought.spheres}
    findings: list[Contradiction] = []
    for m in odd:
        there = found.get(m)
        off_mm = None if there is None or 2 * there.measured < there.expected else there.displacement_mm
        images_of = counted(expected[m], "image")
        if off_mm is None:
            what = f"Sphere {m} was not found in {images_of} that should show it, within {mm(WINDOW_M):.0f} mm"
            remedy = "Remove it from the list if it was taken away; uncover it if it is hidden"
        else:
            what = f"Sphere {m} is {off_mm:.2f} mm from where the list has it, by {images_of}; it was not used"
            remedy = "It was moved between scan and images, or its place in the list is wrong: scan again"
        findings.append(Contradiction("sphere not found", what, remedy))
    if len(odd) > _MOST_LACKING * len(expected):
        what = f"{len(odd)} of the {counted(len(expected), 'sphere')} of the list are not where it has them"
        remedy = "Check the list, its unit and its scene: the rest may fit by chance"
        findings.insert(0, Contradiction("spheres not found", what, remedy, refuses=True))
    return tuple(findings)


def require_handedness(
    outlines: Sequence[Sequence[SphereOutline]], images: PosedImages, spheres: ScanSpheres
) -> None:
    """Check that the list of spheres is not mirrored.

    Raises:
        ComputeError: single images show the spheres in the mirrored arrangement of the list.
    """
    most = sorted(range(len(outlines)), key=lambda i: -len(outlines[i]))[:_COMPARED]
    mirrored = spheres.centres_m * [1.0, -1.0, 1.0]
    explained = [
        sum(
            readings[0].count
            for i in most
            if (readings := image_hypotheses(outlines[i], centres, spheres.radius_m, images.camera))
        )
        for centres in (spheres.centres_m, mirrored)
    ]
    if explained[1] > max(_MIRRORED_GAIN * explained[0], 3):
        raise ComputeError(
            f"the list of spheres is mirrored: as it is, it explains {counted(explained[0], 'outline')} of "
            f"{counted(len(most), 'image')}, mirrored {explained[1]}",
            where="sphere list",
            remedy="Write the list in a right-handed frame: change the sign of one axis, or export the mesh again",
        )


UNEXPLAINED = "unexplained"  # name of the component of the covariance
_FREE_PX, _FREE_FOCAL = 20.0, 0.03  # widths of the fit that leaves the errors free: px, relative
_SIGMAS = 5.0
# Clean rendered scenes (bench/registration/faults_table.py) gave a relative error of the focal length of at most
# 0.8e-4, by what single outlines share: a calibration is not expected to be better.
_EXPECTED_FOCAL = 0.5e-4
_SHARP_PX = 0.7  # blur up to which the sizes of the common errors were measured; they grow with it
_NAMED_BLUR = 1.3  # times that, from which blur is reported
_LIGHT_OF_GROWTH = 2 / 3  # as in EXPECTED_COMMON_ERRORS
# Clean rendered scenes gave at most 1.1e-4 with focal length and scale free.
_EXPECTED_SCALE = 1e-4
_SIGN_OF_SCALE = 2e-4  # from which the positions that the outlines prefer are a sign of another scale
_AGREES = 3.0  # standard deviations
_LEAST_POSITIONS = 4  # that determine a scale

CommonErrorName = Literal["shift_x_px", "shift_y_px", "growth_px", "focal_x", "focal_y", "scale"]


@dataclass(frozen=True, slots=True)
class CommonError:
    """One error that all outlines share.

    Focal lengths are relative, given over true, less one; the scale is that of the list of spheres, in camera
    positions, less one.
    """

    name: CommonErrorName
    value: float
    sigma: float
    expected: float  # standard deviation by which it may differ from zero

    @property
    def uncertainty(self) -> float:
        """Standard deviation of the value as an error of the inputs: it includes their expected size."""
        return float(np.hypot(self.sigma, self.expected))

    @property
    def significant(self) -> bool:
        """True if it is larger than its uncertainty allows."""
        return abs(self.value) > _SIGMAS * self.uncertainty


@dataclass(frozen=True, slots=True)
class BeyondModel:
    """The result of the fit that leaves the errors common to all outlines free.

    Attributes:
        errors: the common errors as the outlines have them; empty if they do not determine them.
        blur_px: median blur of the outlines.
        component: (6, 6) covariance of T_world_scan for what the model does not explain; zero if it explains all.
        findings: texts of the causes.
    """

    errors: tuple[CommonError, ...]
    blur_px: float
    component: Array
    findings: tuple[Contradiction, ...]


def beyond_model(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    held: RegistrationResult,
    settings: RegistrationSettings,
    *,
    lens_covariance: Array | None = None,
) -> BeyondModel:
    """Compare a registration with one that leaves the errors that all outlines share free.

    Args:
        outlines: the registration's outlines.
        assignments: the registration's assignments.
        images: the registration's images.
        spheres: the registration's spheres.
        held: the registration, with the common errors near zero and the camera as calibrated.
        settings: the registration's settings.
        lens_covariance: (8, 8) covariance of the calibration; None if it is not given.
    """
    camera = images.camera
    blur_px = float(np.median([o.systematic_px for o in held.solution.problem.outlines])) / SYSTEMATIC_PER_BLUR
    lens = np.diag([(_FREE_FOCAL * camera.fx) ** 2, (_FREE_FOCAL * camera.fy) ** 2, *[1e-12] * 2, *[1e-18] * 4])
    common = settings.common_errors
    wide = replace(
        settings,
        intrinsics_covariance=lens,
        common_errors=CommonErrors(_FREE_PX, _FREE_PX, common.light_px, common.own_light_px),
    )
    free = _fitted(outlines, assignments, images, spheres, wide)
    errors = () if free is None else _errors(free, images, common, lens_covariance)
    if images.metric and (
        _focal_length_is_off(errors) or abs(_scale_of_positions(held, images) - 1) > _SIGN_OF_SCALE
    ):
        scaled = _fitted(outlines, assignments, replace(images, metric=False), spheres, wide)
        told = () if scaled is None else _errors(scaled, images, common, lens_covariance)
        if any(e.significant for e in told if e.name == "scale") or _focal_length_is_off(told):
            free, errors = scaled, told  # else the images cannot separate the two
    significant: dict[CommonErrorName, CommonError] = {e.name: e for e in errors if e.significant}
    component = np.zeros((6, 6))
    if free is not None and significant:
        ways = _perturbations(held, free)
        component += sum(np.outer(moved, moved) for moved in ways) / len(ways)
    light_px = _light_px(significant.get("growth_px"), blur_px, common)
    light_m = held.solution.problem.light_unit_m * float(np.sqrt(max(0.0, light_px**2 - common.light_px**2)))
    component += block_diag(light_m**2 * np.eye(3), np.zeros((3, 3)))
    growth = next((e for e in errors if e.name == "growth_px"), None)
    return BeyondModel(errors, blur_px, component, _findings(significant, growth, blur_px, held, camera.fx))


def _fitted(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    settings: RegistrationSettings,
) -> RegistrationResult | None:
    """Return the registration; None if the outlines do not determine so much."""
    try:
        return register(outlines, assignments, images, spheres, settings)
    except ComputeError:
        return None


def _focal_length_is_off(errors: Sequence[CommonError]) -> bool:
    return any(e.significant for e in errors if e.name in ("focal_x", "focal_y"))


def _scale_of_positions(held: RegistrationResult, images: PosedImages) -> float:
    """Return the camera positions' scale by the outlines over the given one, at the station that differs most.

    An estimate that takes no time: poses that are trusted too much move less.
    """
    stations = images.stations
    more: list[float] = []
    for g in sorted(set(stations.tolist())):
        placed = (stations == g) & np.isfinite(held.T_scan_camera_refined).all(axis=(1, 2))
        if np.count_nonzero(placed) >= _LEAST_POSITIONS:
            refined_m = held.T_scan_camera_refined[placed, :3, 3]
            more.append(align_points(refined_m, images.poses[placed, :3, 3], with_scale=True)[1])
    return max(more, key=lambda s: abs(s - 1), default=1.0)


def held_lens_covariance(uncertain: RegistrationResult, lens_covariance: Array, *, refined: bool = False) -> Array:
    """Propagate a calibration's errors to T_world_scan, (6, 6), if the camera is held as calibrated.

    The covariance is whole, not what the outlines leave of it, since the camera is not corrected: an error e of the
    lens moves the unknowns by V e, V the regression of their errors on those of the lens.

    Args:
        uncertain: the registration with this covariance as a prior.
        lens_covariance: (8, 8) covariance of the calibration.
        refined: true if the scan is meant relative to the cameras that the outlines refined.
    """
    problem, joint = uncertain.solution.problem, uncertain.solution.covariance
    lens = slice(problem.lens_column, problem.size)
    V = np.linalg.solve(joint[lens, lens], joint[lens]).T
    moved = uncertain.refined_gain()[0] @ V if refined else V[:6]
    return np.asarray(moved @ lens_covariance @ moved.T, dtype=np.float64)


def _errors(
    free: RegistrationResult, images: PosedImages, common: CommonErrors, lens_covariance: Array | None
) -> tuple[CommonError, ...]:
    solution, problem = free.solution, free.solution.problem
    values = solution.state.common[3:8]
    first = problem.common_column + 3
    sigma = np.sqrt(np.maximum(np.diag(solution.covariance)[first : first + 5], 0.0))
    f = np.array([images.camera.fx, images.camera.fy])
    stated = np.zeros(4) if lens_covariance is None else np.sqrt(np.maximum(np.diag(lens_covariance)[:4], 0.0))
    focal = np.hypot(stated[:2] / f, _EXPECTED_FOCAL)
    shift = np.hypot(stated[2:], common.shift_px)
    expected = (*shift.tolist(), common.growth_px, *focal.tolist())
    unit = (1.0, 1.0, 1.0, *f.tolist())
    names: tuple[CommonErrorName, ...] = ("shift_x_px", "shift_y_px", "growth_px", "focal_x", "focal_y")
    out = tuple(
        CommonError(name, float(v) / u, float(s) / u, e)
        for name, v, s, u, e in zip(names, values, sigma, unit, expected, strict=True)
    )
    if not images.metric or not problem.with_scale:
        return out
    of_scale = float(np.sqrt(max(solution.covariance[problem.scale_column, problem.scale_column], 0.0)))
    return (*out, CommonError("scale", free.scale - 1, free.scale * of_scale, _EXPECTED_SCALE))


def _perturbations(held: RegistrationResult, free: RegistrationResult) -> tuple[Array, ...]:
    """Return (6,) perturbations of T_world_scan, against the cameras, from the one registration to the other.

    Two, if their scales differ: the one holds if the positions are wrong, the other if the list is.
    """
    placed = np.isfinite(held.T_scan_camera).all(axis=(1, 2)) & np.isfinite(free.T_scan_camera).all(axis=(1, 2))
    T, _ = align_points(held.T_scan_camera[placed, :3, 3], free.T_scan_camera[placed, :3, 3])
    R = held.T_world_scan[:3, :3]
    if held.solution.problem.with_scale:
        return (np.concatenate([R @ T[:3, 3], Rotation.from_matrix(R @ T[:3, :3] @ R.T).as_rotvec()]),)
    # Given metric poses, the scan moves in their frame.
    turn = Rotation.from_matrix(free.T_world_scan[:3, :3] @ R.T).as_rotvec()
    scales = (1.0, free.scale) if free.solution.problem.with_scale else (1.0,)
    return tuple(
        np.concatenate([free.T_world_scan[:3, 3] / scale - held.T_world_scan[:3, 3], turn]) for scale in scales
    )


def _light_px(growth: CommonError | None, blur_px: float, common: CommonErrors) -> float:
    """Return the bias by light from one side that outlines of this blur and growth may have."""
    if blur_px <= _SHARP_PX:
        return common.light_px
    by_growth = 0.0 if growth is None else _LIGHT_OF_GROWTH * abs(growth.value)
    return max(common.light_px * blur_px / _SHARP_PX, by_growth)


def _findings(
    significant: dict[CommonErrorName, CommonError],
    growth: CommonError | None,
    blur_px: float,
    held: RegistrationResult,
    f: float,
) -> tuple[Contradiction, ...]:
    out: list[Contradiction] = []
    focal = [significant[name] for name in ("focal_x", "focal_y") if name in significant]
    if focal:
        sizes = " and ".join(
            f"{'fx' if e.name == 'focal_x' else 'fy'} by {100 * abs(e.value):.3f} ± {100 * e.uncertainty:.3f} % too "
            f"{'large' if e.value > 0 else 'small'}"
            for e in focal
        )
        out.append(
            Contradiction(
                "focal length",
                f"The outlines contradict the focal length: {sizes}, if the camera positions are right",
                "Calibrate the camera at this focus and zoom. If it is right, the cameras are nearer or farther "
                "than their poses say: check the hand-eye along the optical axis, and the positions' scale. The "
                "images cannot tell these apart",
            )
        )
    shift = [significant[name] for name in ("shift_x_px", "shift_y_px") if name in significant]
    if shift:
        sizes = " and ".join(
            f"{'cx' if e.name == 'shift_x_px' else 'cy'} by {abs(e.value):.2f} px ± {e.uncertainty:.2f} too "
            f"{'large' if e.value < 0 else 'small'}"
            for e in shift
        )
        out.append(
            Contradiction(
                "principal point",
                f"The outlines are shifted as by a wrong principal point: {sizes}",
                "Calibrate the camera, and check that the images are neither cropped nor shifted by a stabiliser. "
                "If the camera is right, all poses are turned alike: check the hand-eye. The images cannot tell "
                "these apart",
            )
        )
    scale = significant.get("scale")
    by_size = None if scale is None or growth is None else _contradicts_radius(scale, growth, _radius_px(held, f))
    if scale is not None:
        out.append(_scale_finding(scale, by_size))
    if growth is not None and growth.significant and by_size != "list":
        out.append(_size_finding(growth, blur_px, held, f))
    elif blur_px > _NAMED_BLUR * _SHARP_PX:
        out.append(
            Contradiction(
                "blur",
                f"The outlines are blurred over {blur_px:.1f} px; the stated sigma is larger for it",
                "Focus, and expose for less time or with the camera at rest",
            )
        )
    return tuple(out)


def _radius_px(held: RegistrationResult, f: float) -> float:
    return f * float(np.median(held.solution.problem.cones.half_angles))


def _contradicts_radius(
    scale: CommonError, growth: CommonError, radius_px: float
) -> Literal["list", "positions"] | None:
    """Return whether list or positions contradict the spheres' radius by the outlines' size; None if that is open."""
    grown, uncertainty = growth.value / radius_px, growth.uncertainty / radius_px
    with_list = abs(grown) <= _AGREES * uncertainty  # outlines as large as the list has them
    with_positions = abs(grown - scale.value) <= _AGREES * uncertainty
    if with_list == with_positions:
        return None
    return "positions" if with_list else "list"


def _scale_finding(scale: CommonError, by_size: Literal["list", "positions"] | None) -> Contradiction:
    larger = "larger" if scale.value > 0 else "smaller"
    agrees = {
        "list": "; the outlines are as large as the positions say, so that the list is wrong",
        "positions": "; the outlines are as large as the list says, so that the positions are wrong, or the list "
        "with its radius",
        None: "",
    }[by_size]
    of_list = "Check the unit of the list, and how scanner and mesh's program were calibrated and set"
    of_positions = (
        "Check the unit of the positions, and the robot's calibration; with --estimate-scale, only the list's scale "
        "counts"
    )
    remedy = of_list if by_size == "list" else f"{of_positions}. {of_list}"
    return Contradiction(
        "scale",
        f"The list of spheres is {100 * abs(scale.value):.2f} % ± {100 * scale.uncertainty:.2f} {larger} than the "
        f"camera positions say{agrees}",
        remedy,
        refuses=True,
    )


def _size_finding(growth: CommonError, blur_px: float, held: RegistrationResult, f: float) -> Contradiction:
    problem = held.solution.problem
    radius_px = _radius_px(held, f)
    given_mm = mm(problem.radius_m)
    true_mm, sigma_mm = given_mm * (1 + growth.value / radius_px), given_mm * growth.uncertainty / radius_px
    larger = "larger" if growth.value > 0 else "smaller"
    blurred = f" (they are blurred over {blur_px:.1f} px)" if blur_px > _SHARP_PX else ""
    return Contradiction(
        "size of outlines",
        f"All outlines are {abs(growth.value):.2f} px ± {growth.uncertainty:.2f} {larger} than spheres of radius "
        f"{given_mm:.2f} mm appear{blurred}: by the images the radius is {true_mm:.2f} mm ± {sigma_mm:.2f}",
        "Measure the spheres, coat included, and correct the radius. If it is right, the edges are biased: by blur "
        "of focus or motion, or by the images' processing. The images cannot tell these apart",
    )
