"""What the renderer keeps for the next process: the same pixels, or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulators.rendering import array_cache as module
from simulators.rendering.array_cache import VARIABLE, cached
from simulators.rendering.render import Renderer
from simulators.rig.world_server import World
from simulators.scene.specimen import Specimen
from simulators.scene.world import Scene

WIDTH = 90
SETTINGS = {"exposure_s": 1 / 15, "iso": 100.0, "aperture_f": 22.0}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where arrays are kept."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "kept"))
    return tmp_path / "kept"


class Computing:
    """Computes arrays, and counts how often it was asked."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> list[Any]:
        self.times += 1
        return [np.array([0.1, np.nan, -0.0]), np.arange(6, dtype=np.float32).reshape(2, 3), np.array([[True]])]


def same(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return [(a.dtype, a.shape, a.tobytes()) for a in one] == [(a.dtype, a.shape, a.tobytes()) for a in other]


@pytest.mark.slow
@pytest.mark.sweep
def test_pictures_and_previews_are_the_same_to_the_last_bit_whether_kept_or_computed(folder: Path) -> None:
    scene = Scene.generate(5)
    world = World(scene, WIDTH, (), np.zeros(6), camera_held=True, control_spheres=True)
    view = world.view()
    moved = {**view, "scene": {**view["scene"], "moved": [[2, *(scene.registration_m[2] + 0.01)]]}}

    def pictures() -> list[Any]:
        renderer = Renderer(WIDTH)
        return [*(renderer.render(one, SETTINGS, 7) for one in (view, moved)), renderer.preview(moved)]

    computed = pictures()
    entries = {path: path.stat().st_ino for path in folder.iterdir()}
    assert sorted(path.name.partition("-")[0] for path in entries) == ["light", "light", "specimen", "textures"]
    assert same(pictures(), computed)
    assert {path: path.stat().st_ino for path in folder.iterdir()} == entries


def test_a_specimen_and_what_is_drawn_after_it_are_the_same_whether_kept_or_computed(folder: Path) -> None:
    one, other = (np.random.default_rng(5) for _ in range(2))
    computed = Specimen.generate(one, 48, 32).grid_m
    (entry,) = folder.iterdir()
    before = entry.stat().st_ino
    assert same([Specimen.generate(other, 48, 32).grid_m], [computed])
    assert [path.stat().st_ino for path in folder.iterdir()] == [before]
    assert one.random() == other.random()


def test_nothing_is_kept_unless_the_environment_says_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    compute = Computing()
    for _ in range(2):
        cached("things", [1], compute)
    assert compute.times == 2
    assert not list(tmp_path.iterdir())


def test_what_is_kept_is_the_same_and_is_found_by_all_its_inputs(folder: Path) -> None:
    compute = Computing()
    inputs = (1, 0.1, np.array([1.0, 2.0]), None)
    first = cached("things", inputs, compute)
    assert same(cached("things", inputs, compute), first)
    assert compute.times == 1
    others = [
        ("thing", inputs),
        ("things", (1, np.nextafter(0.1, 1), *inputs[2:])),
        ("things", (1, 0.1, np.array([1.0, np.nextafter(2.0, 3)]), None)),
        ("things", (1, 0.1, np.array([[1.0], [2.0]]), None)),
        ("things", (1, 0.1, np.array([1.0, 2.0], dtype=np.float32), None)),
        ("things", inputs[:3]),
    ]
    for times, (what, given) in enumerate(others, start=2):
        cached(what, given, compute)
        assert compute.times == times, given


@pytest.mark.parametrize("damage", ["half", "byte", "empty", "other"])
def test_a_damaged_entry_is_computed_again(folder: Path, damage: str) -> None:
    compute = Computing()
    first = cached("things", [1], compute)
    (path,) = folder.iterdir()
    data = path.read_bytes()
    at = data.index(np.arange(6, dtype=np.float32).tobytes())
    spoilt = {
        "half": data[: len(data) // 2],
        "byte": data[:at] + b"?" + data[at + 1 :],
        "empty": b"",
        "other": b"no archive",
    }
    path.write_bytes(spoilt[damage])
    assert same(cached("things", [1], compute), first)
    assert same(cached("things", [1], compute), first)
    assert compute.times == 2


def test_a_folder_that_cannot_be_is_done_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file"))
    compute = Computing()
    assert same(cached("things", [1], compute), cached("things", [1], compute))
    assert compute.times == 2


def test_the_least_recently_used_entries_go_and_too_large_ones_are_not_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def of(size: int) -> list[Any]:
        return [np.zeros(size, dtype=np.uint8)]

    monkeypatch.setattr(module, "MOST_BYTES", 50_000)
    monkeypatch.setattr(module, "MOST_ENTRY_BYTES", 15_000)
    cached("large", [0], lambda: of(15_001))
    assert not folder.exists()
    folder.mkdir()
    (folder / "things-left.123-4.part").write_bytes(bytes(10_000))
    for number in range(6):
        cached(f"n{number}", [number], lambda: of(10_000))
        cached("n0", [0], lambda: of(10_000))  # used each time
    assert {path.name.partition("-")[0] for path in folder.iterdir()} == {"n0", "n3", "n4", "n5"}


def test_many_at_once_find_whole_entries_only(folder: Path) -> None:
    large = [np.random.default_rng(3).random(200_000)]

    def use(number: int) -> bool:
        return same(cached("large", [number % 3], lambda: large), large)

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(use, range(60)))
    assert len(list(folder.iterdir())) == 3
