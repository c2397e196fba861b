"""Scans in several parts: merged by the spheres that they share, with a residual, or refused with the part's name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.interfaces import Scanner
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from service.compute.surfaces.constellations import merge_parts
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse, transform
from service.core.records.run_events import StepFailed
from tests.support.runs.bench_run import begin_run, bench_store, say
from tests.support.runs.computing_run import OneScanner, begin_computing_run

RADIUS_M = 0.006
SPHERES_M = np.array(
    [[0.06, 0.0, 0.02], [-0.055, 0.03, 0.035], [-0.05, -0.045, 0.015], [0.03, 0.055, 0.05], [0.025, -0.06, 0.03],
     [0.12, 0.02, 0.045], [0.10, -0.07, 0.01]]
)  # fmt: skip
SHOWN = ((0, 1, 2, 3, 4), (4, 0, 5, 3, 2), (6, 5, 4, 2, 0))  # by each part, in its own order
PROTOCOL = """\
id: parts
version: "1"
title: A scan in three parts
spheres: {radius_mm: 6, registration: 7, control: 0}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: scan
    kind: scan_import
    title: Scan
    confirm: false
    params: {spheres: 7, parts: 3, wait_s: 20}
    gates: [{measure: part_residual_max_mm, max: 0.1, unit: mm}]
"""


def poses(seed: int) -> list[Array]:
    """T_world_part of three parts."""
    rng = np.random.default_rng(seed)
    return [transform(Rotation.random(random_state=seed + k), rng.uniform(-0.3, 0.3, 3)) for k in range(len(SHOWN))]


def parts_of(T_world_part: Sequence[Array], noise_m: float = 0.0, seed: int = 0) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [
        apply(inverse(T), SPHERES_M[list(shown)] + rng.normal(0, noise_m, (len(shown), 3)))
        for T, shown in zip(T_world_part, SHOWN, strict=True)
    ]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_parts_are_placed_wherever_they_lie(seed: int) -> None:
    T_world_part = poses(seed)
    merged = merge_parts(parts_of(T_world_part))
    assert (merged.spheres, merged.shared) == (7, 5)  # spheres 1 and 6 are in one part each
    for found, T in zip(merged.T_first_part, T_world_part, strict=True):
        np.testing.assert_allclose(found, inverse(T_world_part[0]) @ T, atol=1e-9)
    assert merged.residuals_m.max() < 1e-9


def test_the_residual_is_that_of_the_spheres() -> None:
    noise_m = 50e-6
    found = [merge_parts(parts_of(poses(seed), noise_m, seed)).rms_m for seed in range(20)]
    # 13 observations of 5 shared spheres: of 39 coordinates, 15 go into the means and 12 into two poses.
    expected = noise_m * np.sqrt(3 * (39 - 15 - 12) / 39)
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(expected, rel=0.15)


def test_a_part_that_shares_too_little_or_is_mirrored_is_named() -> None:
    few = parts_of(poses(1))
    few[2] = few[2][:3]
    with pytest.raises(ComputeError, match=r"part 3 of the scan cannot be placed: no 4 of \d and \d"):
        merge_parts(few)
    mirrored = parts_of(poses(1))
    mirrored[1] = mirrored[1] * [1, 1, -1]
    with pytest.raises(ComputeError, match=r"part 2 of the scan cannot be placed: .*mirror images"):
        merge_parts(mirrored)


def test_a_run_waits_for_all_parts_and_makes_one_mesh(tmp_path: Path) -> None:
    T_world_part = poses(3)
    rig = OneScanner()
    rig.folder = tmp_path / "scans"
    rig.folder.mkdir()
    for number, (T, shown) in enumerate(zip(T_world_part, SHOWN, strict=True)):
        balls = [
            trimesh.creation.icosphere(3, 1e3 * RADIUS_M).apply_translation(1e3 * centre)
            for centre in apply(inverse(T), SPHERES_M[list(shown)])
        ]
        trimesh.util.concatenate(balls).export(rig.folder / f"part{number}.ply")
    with bench_store(tmp_path / "data") as store:
        bench = begin_computing_run(store, PROTOCOL, tmp_path, rig)
        state = bench.run()
        assert state.status == "completed", state
        scan = state.steps["scan"]
        assert scan.measures["scan_parts"] == 3
        assert scan.measures["part_spheres_shared"] == 5
        assert scan.measures["part_residual_max_mm"] < 0.05
        (mesh,) = [ref for ref in scan.artefacts if ref.kind == "scan_mesh"]
        with np.load(store.artefact_path(mesh.sha256)) as merged:
            assert len(merged["faces"]) == scan.measures["faces"]
        assert len([ref for ref in scan.artefacts if ref.kind == "scan_part_original"]) == 3
        found = np.array(scan.result["spheres_m"])
    first = min(range(3), key=lambda k: (rig.folder / f"part{k}.ply").stat().st_mtime_ns)
    placed = apply(T_world_part[first], found)
    away = np.linalg.norm(placed[:, None] - SPHERES_M[None], axis=2).min(axis=1)
    assert len(found) == len(SPHERES_M)
    assert away.max() < 0.05e-3


class OneZivid(OneScanner):
    """The bench with a scanner whose program exports views."""

    def scanner(self, name: str | None = None) -> Scanner:
        return cast(Scanner, ScanFolder(ScanFolderConfig(folder=self.folder, stable_s=0, profile="zivid")))


def test_a_step_that_waits_in_vain_says_what_is_wrong_with_the_file_that_came(tmp_path: Path) -> None:
    rig = OneZivid()
    rig.folder = tmp_path / "scans"
    rig.folder.mkdir()
    trimesh.creation.icosphere(1, 1e3 * RADIUS_M).export(rig.folder / "part.stl")
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.rig = rig

        bench.script("scan", "recovery", say("abort", reason="another program exported it"))
        assert bench.run().status == "aborted"
        *_, failed = bench.payloads(StepFailed)
    assert (
        "3 complete scan exports did not arrive within 20 s; part.stl: the profile zivid does not" in failed.message
    )
    assert "save as PLY, ordered" in failed.message
