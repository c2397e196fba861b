"""Camera poses of images that show where they were taken by nothing but their spheres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.capture.hand_bundle import ImageReading, adjust_together
from service.compute.capture.hand_view import pose_by_spheres
from service.compute.markers.records import SphereOutline
from service.compute.registration.identification.identity import identify_each
from service.compute.scene import ScanSpheres
from service.core.geometry import Transform, inverse


def poses_by_spheres(
    outlines: Sequence[Sequence[SphereOutline]], names: Sequence[str], camera: CameraModel, spheres: ScanSpheres
) -> dict[str, Transform]:
    """T_scene_camera of every image whose spheres determine it, by its name.

    The list of spheres says which is which. The poses themselves come from the photographs alone, by an adjustment of
    all cameras and spheres together, so that a registration with them tests the list. Where too few images share
    their spheres for that, each pose comes from its own image and the list.

    Args:
        outlines: of N images, each searched whole.
        names: of the N images.
        camera: of the images.
        spheres: the list.

    Raises:
        ComputeError: no image shows four spheres in the arrangement of the list.
    """
    readings: list[ImageReading] = []
    for name, found, assigned in zip(names, outlines, identify_each(outlines, camera, spheres), strict=True):
        start = assigned.T_camera_scan if assigned.markers else None
        pose, markers = pose_by_spheres(start, found, camera, spheres.centres_m, spheres.radius_m)
        if pose is not None:
            shown = {sphere: found[outline] for outline, sphere in markers.items()}
            readings.append(ImageReading.of(name, inverse(pose), shown))
    together = adjust_together(readings, np.asarray(spheres.centres_m), camera, spheres.radius_m)
    alone = {reading.viewpoint: reading.T_scene_camera for reading in readings}
    return alone if together is None else dict(together.poses)
