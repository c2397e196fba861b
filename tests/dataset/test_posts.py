"""Masks cover the posts of a simulated run, though its scan shows no board, and crops keep clear of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from service.audit.recorded_run import RecordedRun, read_run
from service.compute.images.render import Cylinder, WorldSphere, marker_mask
from service.compute.surfaces.constellations import match_constellations
from service.core.geometry import apply
from service.dataset.pixels import cropped_data_set
from service.dataset.records import DataSet
from service.dataset.run_data_set import data_set_of, posts_of, specimen_pixels
from service.dataset.summary import RunSummary
from simulators.scene.world import POST_RADIUS_M, RADIUS_M, Scene
from tests.support.recorded.unpacked_run import unpack_recorded_run

pytestmark = pytest.mark.timeout(300)
SEED = 7  # of the simulated rig of the recorded run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return read_run(unpack_recorded_run(tmp_path_factory.mktemp("recorded")), "latest")


@pytest.fixture(scope="module")
def dataset(run: RecordedRun) -> DataSet:
    return data_set_of(run.summary())


@pytest.fixture(scope="module")
def true_posts(run: RecordedRun) -> list[Cylinder]:
    """The posts of the simulated scene, from the sphere's lower end to the board, in the frame of the scan."""
    scene = Scene.generate(SEED)
    T_scan_scene = match_constellations(np.array(run.summary().scan_spheres_m()), scene.registration_m).T_a_b
    tops = scene.registration_m - [0.0, 0.0, RADIUS_M]
    ends = zip(apply(T_scan_scene, tops), apply(T_scan_scene, scene.foot_m), strict=True)
    return [Cylinder(top, foot, POST_RADIUS_M) for top, foot in ends]


def test_the_true_posts_are_masked(dataset: DataSet, true_posts: list[Cylinder]) -> None:
    shown = 0
    for view in dataset.views:
        true = marker_mask(view.camera, view.T_world_camera, (), true_posts)
        shown += int(true.sum())
        assert not (true & ~dataset.pixels.markers(view)).any()
    assert shown > 1000
    assert "the posts below 10 of them, down to the table" in dataset.statement["masks"]


def test_crops_keep_clear_of_the_true_posts(run: RecordedRun, dataset: DataSet, true_posts: list[Cylinder]) -> None:
    summary = run.summary()
    crops = cropped_data_set(dataset, lambda view: specimen_pixels(summary, view), (96, 64), most=2)
    assert len(crops.views) >= len(dataset.views)
    for view in crops.views:
        assert not marker_mask(view.camera, view.T_world_camera, (), true_posts).any()


def spheres_of(summary: RunSummary) -> list[WorldSphere]:
    return [WorldSphere(np.array(centre), RADIUS_M) for centre in summary.scan_spheres_m()]


def test_without_an_arm_or_its_rig_file_the_posts_are_not_known(run: RecordedRun, dataset: DataSet) -> None:
    summary = run.summary()
    first, *others = summary.events
    root = first.model_copy(update={"payload": summary.root.model_copy(update={"origin": "imported"})})
    imported = dataclasses.replace(summary, events=[root, *others])
    (step,) = (step.id for step in run.protocol.steps if step.gives == "registrations")
    now = run.state.steps[step]
    by_images = {name: T for name, T in now.result["registrations"].items() if "robot" not in name}
    jobs = {name: job for name, job in now.jobs.items() if "robot" not in str(job.arguments.get("poses"))}
    result = {**now.result, "registrations": by_images}
    steps = {**run.state.steps, step: dataclasses.replace(now, result=result, jobs=jobs)}
    no_arm = dataclasses.replace(summary, state=dataclasses.replace(run.state, steps=steps))
    assert posts_of(summary, spheres_of(summary), dataset.views).cylinders
    for without in (imported, no_arm):
        posts = posts_of(without, spheres_of(summary), dataset.views)
        assert posts.cylinders == ()
        assert "posts are not masked" in posts.words
