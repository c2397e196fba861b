"""Camera poses of images that show where they were taken by nothing but their spheres."""

from __future__ import annotations

from collections.abc import Sequence

from service.compute.camera_model import CameraModel
from service.compute.capture.hand_view import pose_by_spheres
from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import identify_each
from service.compute.scene import ScanSpheres
from service.core.geometry import Transform, inverse


def poses_by_spheres(
    outlines: Sequence[Sequence[SphereOutline]], names: Sequence[str], camera: CameraModel, spheres: ScanSpheres
) -> dict[str, Transform]:
    """T_scan_camera of every image whose spheres determine it, by its name; each from its own image.

    Args:
        outlines: of N images, each searched whole.
        names: of the N images.
        camera: of the images.
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
