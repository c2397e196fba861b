"""Finds inputs that contradict the others, and says what to do about each: images, spheres, mirrored lists."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from service.compute.evaluation.control_spheres import WINDOW_M, SearchNearby, evaluate_controls
from service.compute.markers.predicted import CLEARLY_VISIBLE, visible_cones
from service.compute.markers.records import SphereOutline
from service.compute.registration.hypotheses import image_hypotheses, rivals
from service.compute.registration.identity import Assignment
from service.compute.registration.result import RegistrationResult
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad
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
