"""Job `further_view`: an image of a further camera; its spheres, its sharpness, and whether it locates the camera."""

from __future__ import annotations

import cv2
import numpy as np

from service.computations import further_view as job
from service.computations.job import JobAnswer, JobContext, finite
from service.computations.records import matrix
from service.compute.images.photographs import read_image_of
from service.compute.live import expected_spheres, image_measures
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import outline_record
from service.compute.poses.pose_files import read_camera_json
from service.compute.registration.further_camera import sighted_pose
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import inverse


def further_view(context: JobContext[job.Arguments]) -> JobAnswer:
    """Find the spheres in the image, and locate the camera by them if there are enough."""
    cv2.setNumThreads(1)  # the capture goes on in parallel
    arguments, image = context.arguments, context.arguments.image
    camera = read_camera_json(context.input(arguments.calibration))
    pixels = read_image_of(context.input(image.sha256), camera)
    outlines = detect_spheres(pixels, camera)
    measures, black = image_measures(pixels, outlines, camera)
    measures["spheres_seen"] = 0.0
    answer = job.Answer(viewpoint=image.viewpoint, device=arguments.device, black=black)
    spheres = ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m)
    try:
        seen = sighted_pose(outlines, camera, spheres, None)
    except ComputeError as error:
        answer = answer.model_copy(update={"reason": error.what})
    else:
        expected = expected_spheres(inverse(seen.T_scan_camera), spheres.centres_m, spheres.radius_m, camera)
        measures |= {"spheres_seen": float(seen.spheres), "spheres_expected": float(len(expected))}
        answer = answer.model_copy(update={"T_ct_camera": matrix(seen.T_scan_camera)})
    records = {image.viewpoint: [outline_record(outline) for outline in outlines]}
    kept = context.keep_json(records, kind="further_view", name=f"{image.viewpoint}.{arguments.device}.json")
    return JobAnswer(finite(measures), (kept,), answer)
