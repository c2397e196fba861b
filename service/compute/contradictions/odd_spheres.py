"""Registration spheres that the images do not show where the list has them, and lists that are mirrored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.compute.contradictions.findings import Contradiction
from service.compute.evaluation.control_spheres import SearchNearby, evaluate_controls
from service.compute.evaluation.seen_places import WINDOW_M
from service.compute.markers.records import SphereOutline
from service.compute.markers.search.predicted import CLEARLY_VISIBLE, visible_cones
from service.compute.registration.identification.hypotheses import image_hypotheses
from service.compute.registration.identification.identity import Assignment
from service.compute.registration.result import RegistrationResult
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import inverse
from service.core.text.counts import counted
from service.core.units import mm

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
    """Spheres of the list that hardly any image shows where it is, and where they are, if the images tell.

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
