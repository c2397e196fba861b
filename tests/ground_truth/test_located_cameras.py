"""Cameras that only the spheres of the scan located bring the CT to the scan, as the spheres alone do."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from service.audit.recorded_run import read_run
from service.computations.registration import REGISTER
from service.computations.scans import LOCATE_SPHERES
from service.core.geometry import apply, inverse
from service.core.jobs import Reference, jobs_of, references_in, resolve
from service.steps.kinds.ground_truth import with_located_images
from tests.support.recorded.recomputed import arm_jobs, computed, without_mount
from tests.support.recorded.unpacked_run import unpack_recorded_run


@pytest.mark.slow
@pytest.mark.sweep  # within a step: test_ground_truth_step.py
@pytest.mark.timeout(300)
def test_the_ct_comes_to_the_scan_through_located_cameras(tmp_path: Path) -> None:
    run = read_run(unpack_recorded_run(tmp_path / "recorded"), "latest")
    jobs = jobs_of(run.state)
    of_scan = without_mount(arm_jobs(run)["robot"])
    answer = computed(run, of_scan, tmp_path, {"state_pose_errors": True})
    of_scan = dataclasses.replace(of_scan, result=answer.result)
    jobs[of_scan.job] = of_scan
    images = with_located_images(of_scan, jobs).arguments["images"]
    assert {found.job for _, found in references_in(images) if isinstance(found, Reference)} == {of_scan.job}
    in_ct, in_scan = (
        LOCATE_SPHERES.read_answer(next(job for job in jobs.values() if job.idempotency_key.startswith(key)).result)
        for key in ("ct_import/0/locate_spheres/", "scanning/0/locate_spheres/")
    )
    spheres = {
        "images": resolve(images, jobs),
        "spheres_m": in_ct.spheres_m,
        "sphere_covariance_m2": [sphere.covariance_m2 for sphere in in_ct.details.spheres],
    }
    of_ct = computed(run, of_scan, tmp_path, spheres)
    T_world_scan, T_world_ct = (np.array(REGISTER.read_answer(one.result).T_world_scan) for one in (answer, of_ct))
    T_scan_ct = inverse(T_world_scan) @ T_world_ct
    assert np.linalg.norm(T_scan_ct[:3, 3]) > 0.01  # the frames are not the same
    distance_m, _ = KDTree(apply(T_scan_ct, np.array(in_ct.spheres_m))).query(np.array(in_scan.spheres_m))
    assert np.max(distance_m) < 5e-4


def test_images_with_known_poses_keep_them(tmp_path: Path) -> None:
    run = read_run(unpack_recorded_run(tmp_path / "recorded"), "latest")
    for job in arm_jobs(run).values():
        assert with_located_images(job, jobs_of(run.state)).arguments == job.arguments
