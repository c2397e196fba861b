"""Layouts of spheres: symmetric ones fail and say what to move, the simulator's pass, motion does not matter."""

from __future__ import annotations

import json
from itertools import combinations, permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from service.cli.main import app
from service.compute.registration.layout import check_layout
from service.compute.registration.photo_layout import merge_places
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points, apply, transform
from simulators.world import Scene


def _decagon(height_m: float = 0.0) -> Array:
    turn = np.arange(10) * (2 * np.pi / 10)
    return np.stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), height_m * (np.arange(10) % 2)], axis=1).astype(
        np.float64
    )


def _grid() -> Array:
    return np.array([[0.1 * x, 0.12 * y, 0.0] for x in range(4) for y in range(3)], dtype=np.float64)


def _mirrored() -> Array:
    half = np.random.default_rng(0).uniform([0.05, -0.2, 0.0], [0.2, 0.2, 0.1], (5, 3))
    return np.concatenate([half, half * [-1, 1, 1]])


@pytest.mark.parametrize("seed", range(1, 11))
def test_the_simulators_scenes_pass(seed: int) -> None:
    scene = Scene.generate(seed)
    for centres in (scene.registration_m, np.concatenate([scene.registration_m, scene.control_m])):
        report = check_layout(np.asarray(centres))
        assert report.passed, report.problems
        assert report.margin_m > 4e-4
        assert report.margin_by_count_m[5] > 2e-3


@pytest.mark.parametrize("centres", [_decagon(), _decagon(0.06), _grid(), _mirrored()])
def test_regular_and_mirrored_layouts_fail(centres: Array) -> None:
    report = check_layout(centres)
    assert not report.passed
    assert report.margin_m < 1e-6
    assert "can be taken for" in report.problems[0]
    first = report.worst[0]
    assert first.spheres != first.taken_for
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(centres[list(first.spheres)], axis=0), axis=1),
        np.linalg.norm(np.diff(centres[list(first.taken_for)], axis=0), axis=1),
        atol=1e-6,
    )


def test_the_advice_helps() -> None:
    centres = _mirrored()
    report = check_layout(centres)
    assert report.moves
    for move in report.moves:
        centres[move.sphere] += move.by_m
    assert check_layout(centres).margin_m > 4e-4
    assert check_layout(centres).margin_m == pytest.approx(report.moves[-1].margin_m)


def test_a_brute_force_search_finds_the_same_margin() -> None:
    centres = np.random.default_rng(3).uniform(-0.2, 0.2, (5, 3))
    best = np.inf
    for seen in combinations(range(5), 4):
        for taken in permutations(range(5), 4):
            if taken != seen:
                a, b = centres[list(seen)], centres[list(taken)]
                T, _ = align_points(a, b)
                best = min(best, float(np.sqrt(np.mean(np.sum((a - apply(T, b)) ** 2, axis=1)))))
    assert check_layout(centres).margin_m == pytest.approx(best, rel=1e-6)


@given(
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-2, 2)] * 3),
    seed=st.integers(0, 10_000),
)
@settings(max_examples=10, deadline=None)
def test_motion_and_order_do_not_matter(
    rotation: tuple[float, float, float], shift: tuple[float, float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    centres = rng.uniform([-0.25, -0.2, 0.0], [0.25, 0.2, 0.12], (9, 3))
    if np.min(np.linalg.norm(centres[:, None] - centres[None], axis=2) + np.eye(9)) < 0.02:
        return
    T = transform(Rotation.from_rotvec(rotation), np.array(shift))
    order = rng.permutation(9)
    plain, moved = check_layout(centres), check_layout(apply(T, centres)[order])
    assert moved.margin_m == pytest.approx(plain.margin_m, abs=1e-9)
    assert moved.depth_m == pytest.approx(plain.depth_m, abs=1e-9)
    assert len(moved.problems) == len(plain.problems)
    np.testing.assert_allclose(moved.sphere_margins_m, plain.sphere_margins_m[order], atol=1e-9)


def test_flat_and_one_sided_spheres_are_told() -> None:
    rng = np.random.default_rng(2)
    flat = rng.uniform(-0.2, 0.2, (8, 3)) * [1, 1, 0.01]
    assert any("plane" in problem for problem in check_layout(flat).problems)
    row = rng.uniform([-0.02, -0.01, 0.0], [0.02, 0.01, 0.02], (7, 3))
    row[:, 1] += np.linspace(-0.2, 0.2, 7)
    assert any("way around" in problem for problem in check_layout(row).problems)
    with pytest.raises(ComputeError, match="same place"):
        check_layout(np.zeros((5, 3)))


def test_photographs_are_merged() -> None:
    rng = np.random.default_rng(6)
    centres = np.asarray(Scene.generate(3).registration_m)
    T = transform(Rotation.from_rotvec([0.3, -0.2, 0.8]), np.array([0.1, 0.0, 0.7]))
    noisy = apply(T, centres) + rng.normal(0, 5e-4, centres.shape)
    spread = np.tile((5e-4) ** 2 * np.eye(3), (10, 1, 1))
    merged, covariances, used = merge_places([(centres[:7], spread[:7]), (noisy[2:], spread[2:])])
    assert used == 2
    assert len(merged) == len(covariances) == 10
    distance = np.linalg.norm(merged[:, None] - merged[None], axis=2)
    # The leading photograph is the second, which shows spheres 2 to 9; 0 and 1 come after them.
    order = [*range(2, 10), 0, 1]
    truth = np.linalg.norm(centres[order][:, None] - centres[order][None], axis=2)
    assert np.abs(distance - truth).max() < 4e-3


def test_command(tmp_path: Path) -> None:
    for name, centres, status in (("good", np.asarray(Scene.generate(2).registration_m), 0), ("bad", _grid(), 1)):
        file = tmp_path / f"{name}.json"
        file.write_text(json.dumps({"radius_mm": 15, "registration_mm": (centres * 1e3).tolist()}))
        answer = CliRunner().invoke(app, ["layout", "--spheres", str(file), "--json"])
        assert answer.exit_code == status, answer.output
        assert json.loads(answer.stdout)["passed"] == (status == 0)
