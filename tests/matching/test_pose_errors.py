"""The poses' own errors in the record of a run, and what becomes of them in relative poses."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from service.audit.recorded_run import read_run
from service.core.jobs import jobs_of
from service.dataset.summary import RunSummary
from service.dataset.view_covariances import own_pose_errors

RECORDED = Path(__file__).parents[1] / "data" / "recorded" / "2026-11-23.tar.xz"


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    folder = tmp_path_factory.mktemp("recorded")
    with tarfile.open(RECORDED) as archive:
        archive.extractall(folder, filter="data")
    return read_run(folder / "data", "latest").summary()


def test_those_of_structure_from_motion_are_its_adjustments_in_metres_and_the_scans_axes(summary: RunSummary) -> None:
    registered = next(r for r in summary.registrations().values() if r.poses in ("colmap", "triangulated", "glomap"))
    models = {
        ref.original_name: ref
        for job in jobs_of(summary.state).values()
        for ref in job.artefacts
        if ref.kind == "sfm_model"
    }
    names = sorted(registered.T_scan_camera)
    joint = own_pose_errors(summary, registered, names)
    assert joint is not None
    assert joint.shape == (6 * len(names), 6 * len(names))
    assert np.linalg.eigvalsh(joint).min() > -1e-9 * np.abs(joint).max()
    R = np.array(registered.T_world_scan)[:3, :3]
    stated: list[bool] = []
    for ref in models.values():
        model = json.loads(summary.store.artefact_path(ref.sha256).read_text(encoding="utf-8"))
        of = model["pose_covariance"]
        position = [registered.scale**2 * R.T @ np.array(of[name])[:3, :3] @ R for name in names if name in of]
        ours = [joint[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] for k in range(len(names))]
        stated.append(len(position) == len(ours) and np.allclose(position, ours, rtol=1e-6, atol=1e-15))
    assert any(stated)


def test_those_of_an_arm_are_not_stated(summary: RunSummary) -> None:
    registered = summary.registrations()["robot_corrected"]
    assert own_pose_errors(summary, registered, sorted(registered.T_scan_camera)) is None
