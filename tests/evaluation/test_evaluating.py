"""The jobs `register` and `evaluate` on exact outlines: table, budget, lower resolution, no control spheres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.computations.job import JobContext, RecordedContext
from service.compute.markers.records import outline_record
from service.core.errors import ComputeError
from service.store.store import Store
from service.worker.loop import HANDLERS
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, exact_outlines, scene

N = 6
SIGMA_M = 0.01e-3


def spheres(centres: Any, seed: int) -> dict[str, Any]:
    """The result of a scan import: centres with noise, and their records."""
    noisy = centres + np.random.default_rng(seed).normal(size=np.shape(centres)) * SIGMA_M
    covariance = (np.eye(3) * SIGMA_M**2).tolist()
    records = [{"centre_m": c.tolist(), "covariance_m2": covariance, "rms_mm": 0.03} for c in noisy]
    return {"spheres_m": noisy.tolist(), "details": {"spheres": records}}


class Bench:
    """A store with a capture in it, and the jobs' arguments."""

    def __init__(self, folder: Path, controls: bool) -> None:
        self.store = Store.open(folder / "data")
        self.scratch = folder
        made = scene(N, width=1200, seed=5)
        self.made = made
        every = np.vstack([REGISTRATION_M, CONTROL_M]) if controls else REGISTRATION_M
        outlines = [exact_outlines(made, i, every, noise_px=0.05, seed=5)[0] for i in range(N)]
        blank = cv2.imencode(".jpg", np.full((800, 1200, 3), 90, np.uint8))[1].tobytes()
        photograph = self.store.put_bytes(blank, kind="image", media_type="image/jpeg", original_name="a.jpg")
        self.images = [
            {"viewpoint": f"v{i}", "station": "station_1", "step": "capture", "sha256": photograph.sha256}
            for i in range(N)
        ]
        found = {f"v{i}": [outline_record(o) for o in mine] for i, mine in enumerate(outlines)}
        poses = {f"v{i}": T.tolist() for i, T in enumerate(made.T_world_camera)}
        self.scan = spheres(REGISTRATION_M, 1)
        self.shared = {
            "images": self.images,
            "camera": made.camera.record(),
            "outlines": self.keep(found),
            "model": self.keep({"T_world_camera": poses}),
            "spheres_m": self.scan["spheres_m"],
            "sphere_covariance_m2": [s["covariance_m2"] for s in self.scan["details"]["spheres"]],
            "radius_m": RADIUS_M,
        }

    def keep(self, data: Any) -> str:
        text = json.dumps(data).encode()
        return self.store.put_bytes(text, kind="x", media_type="application/json", original_name="x.json").sha256

    def context(self, arguments: dict[str, Any]) -> RecordedContext:
        return JobContext(arguments, self.store, self.scratch, lambda _what, _done, _all: None)

    def register(self, **more: Any) -> dict[str, Any]:
        return dict(HANDLERS["register"](self.context({**self.shared, "poses": "colmap", **more})).result)

    def evaluate(self, registrations: dict[str, Any], **more: Any) -> dict[str, Any]:
        arguments = {
            "images": self.images, "registrations": registrations, "scan": self.scan, "control_scan": None,
            "ct": None, "radius_m": RADIUS_M, **more,
        }  # fmt: skip
        answer = HANDLERS["evaluate"](self.context(arguments))
        return {**answer.result, "measures": dict(answer.measures), "artefacts": answer.artefacts}


@pytest.fixture
def controlled(tmp_path: Path) -> Any:
    bench = Bench(tmp_path, controls=True)
    yield bench
    bench.store.close()


@pytest.fixture
def uncontrolled(tmp_path: Path) -> Any:
    bench = Bench(tmp_path, controls=False)
    yield bench
    bench.store.close()


@pytest.mark.slow
def test_table_and_budget_with_control_spheres_and_ct(controlled: Bench) -> None:
    covariance = np.diag([0.3, 0.3, 0.2, 0.2, 1e-4, 1e-4, 1e-5, 1e-5]) ** 2
    colmap = controlled.register(intrinsics_covariance=covariance.tolist())
    answer = controlled.evaluate(
        {"colmap": colmap},
        control_scan=spheres(np.vstack([REGISTRATION_M, CONTROL_M]), 2),
        ct=spheres(REGISTRATION_M + np.array([0.1, 0.0, 0.2]), 3),
    )
    (row,) = answer["table"]
    assert row["evaluated_on"] == "control spheres"
    assert row["resolution"] == "1200 × 800"
    assert row["mean_radial_error_mm"] < 0.08
    budget = answer["budgets"]["colmap"]
    names = {c["name"] for c in budget["contributions"]}
    assert {"outlines", "poses", "spheres", "intrinsics", "scan", "ct"} <= names
    assert [c["name"] for c in budget["contributions"] if not c["counted"]] == ["ct"]
    assert {o["name"] for o in budget["observations"]} == {
        "control spheres", "camera ↔ scan", "scan ↔ CT", "camera ↔ CT",
    }  # fmt: skip
    counted = [c["sigma_mm"] for c in budget["contributions"] if c["counted"]]
    assert budget["total_mm"] == pytest.approx(np.sqrt(np.sum(np.square(counted))))
    without_scan = [c["sigma_mm"] for c in budget["contributions"] if c["counted"] and c["name"] != "scan"]
    assert row["predicted_error_mm"] == pytest.approx(np.sqrt(np.sum(np.square(without_scan))))
    kinds = [ref.kind for ref in answer["artefacts"]]
    assert "error_budget" in kinds
    assert "overlay" in kinds


def test_without_control_spheres_each_sphere_is_left_out_in_turn(uncontrolled: Bench) -> None:
    colmap = uncontrolled.register()
    answer = uncontrolled.evaluate({"colmap": colmap})
    (row,) = answer["table"]
    assert row["evaluated_on"] == "each sphere left out"
    assert 0 < row["mean_radial_error_mm"] < 0.1
    assert "control_normalised_chi2" not in answer["measures"]
    assert {o["name"] for o in answer["budgets"]["colmap"]["observations"]} == {"camera ↔ scan"}


def test_too_few_spheres_to_leave_one_out_are_named(uncontrolled: Bench) -> None:
    colmap = {**uncontrolled.register(), "leave_one_out": None}
    with pytest.raises(ComputeError, match="no control spheres"):
        uncontrolled.evaluate({"colmap": colmap})


def test_a_registration_without_poses_of_the_control_images_is_refused(controlled: Bench) -> None:
    colmap = {**controlled.register(), "T_scan_camera": {}}
    with pytest.raises(ComputeError, match="none of the control images"):
        controlled.evaluate({"colmap": colmap}, control_scan=spheres(np.vstack([REGISTRATION_M, CONTROL_M]), 2))


@pytest.mark.slow
def test_a_displaced_control_sphere_fails_its_own_gate_and_is_told(controlled: Bench) -> None:
    colmap = controlled.register()
    figures: list[float] = []
    for by_mm in (0.0, 2.0, 8.0, 10.0, 30.0):
        listed = np.vstack([REGISTRATION_M, CONTROL_M])
        listed[-1] += [1e-3 * by_mm, 0.0, 0.0]
        answer = controlled.evaluate({"colmap": colmap}, control_scan=spheres(listed, 2))
        figures.append(answer["measures"]["worst_control_sphere_mm"])
        (row,) = answer["table"]
        told = [sphere["finding"] for sphere in row["control_spheres"] if sphere["finding"]]
        assert len(told) == (by_mm > 0)
        assert answer["measures"]["control_spheres"] == 3
    assert figures == sorted(figures)
    assert figures[0] < 0.1
    assert figures[1] > 0.5


@pytest.mark.usefixtures("one_processor")
def test_a_control_sphere_that_was_taken_away_is_not_counted_as_measured(controlled: Bench) -> None:
    elsewhere = np.array([[0.0, 0.09, 0.07]])
    listed = spheres(np.vstack([REGISTRATION_M, CONTROL_M, elsewhere]), 2)
    answer = controlled.evaluate({"colmap": controlled.register()}, control_scan=listed)
    assert answer["measures"]["control_spheres"] == 3
    assert answer["measures"]["control_spheres_expected"] == 4
    assert answer["measures"]["control_outlines_share"] == 0
    (row,) = answer["table"]
    assert [s["measured"] > 0 for s in row["control_spheres"]].count(False) == 1
    assert "found in none of" in next(s["finding"] for s in row["control_spheres"] if s["finding"])


def test_an_image_whose_pose_contradicts_the_others_is_left_out_of_the_job_and_named(controlled: Bench) -> None:
    poses = {f"v{i}": T.copy() for i, T in enumerate(controlled.made.T_world_camera)}
    poses["v2"][:3, 3] += 5e-3
    model = controlled.keep({"T_world_camera": {name: T.tolist() for name, T in poses.items()}})
    colmap = controlled.register(model=model)
    assert list(colmap["left_out"]) == ["v2"]
    assert "v2 is left out: its pose is" in colmap["left_out"]["v2"]
    assert [one["kind"] for one in colmap["findings"]] == ["image left out"]
    assert sorted(colmap["T_scan_camera"]) == ["v0", "v1", "v3", "v4", "v5"]
    assert {"growth_px", "focal_x"} <= {one["name"] for one in colmap["common_errors"]}
