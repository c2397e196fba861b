"""Calibration on a bench whose camera photographs a board: planning, replaced images, and mended shortfalls."""

from __future__ import annotations

from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.core.records.run_events import GatesEvaluated, StepMeasured, StepNote, StepRetried
from tests.support.boards.board_bench import MOUNT, PROTOCOL, Picture, board_room
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import Bench, begin_run, bench_store


@pytest.fixture
def begin(tmp_path: Path) -> Generator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as store:
        yield lambda text: begin_run(store, text, tmp_path)


def plans(bench: Bench) -> list[dict[str, Any]]:
    return [dict(note.data) for note in bench.payloads(StepNote) if note.note == "board_poses"]


def names(plan: dict[str, Any]) -> list[str]:
    return [pose["viewpoint"] for pose in plan["poses"]]


@pytest.mark.slow
def test_planned_poses_pass_at_the_first_attempt_without_a_cut_board(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    room = board_room(bench)
    state = bench.run()
    assert state.status == "completed", [q.text for q in bench.operator.asked]
    assert not bench.payloads(StepRetried)
    assert room.cut == []
    found = plans(bench)
    assert [plan["why"] for plan in found] == ["first", "start", "rest"]
    assert len(bench.captured()) == sum(len(plan["poses"]) for plan in found) == 14
    measures = state.steps["calibration"].measures
    assert measures["boards_unseen"] == 0
    predicted = found[-1]["prediction"]
    assert measures["coverage"] >= predicted["coverage"] - 0.05
    mount = np.array(state.steps["calibration"].result["T_flange_camera"])
    assert np.linalg.norm((mount - MOUNT)[:3, 3]) < 1e-3
    bench.must_verify()


def few_images(count: int) -> str:
    """The protocol with so many images, and no gate but that of their number."""
    views = [line for line in PROTOCOL.splitlines() if "measure:" not in line or "views" in line]
    few = "\n".join(views).replace("count: 14, coverage: 1.0", f"count: {count}, coverage: 0.5")
    return few.replace("views, min: 14", f"views, min: {count}")


@pytest.mark.slow
def test_images_without_a_board_and_a_blurred_one_are_replaced_in_the_same_attempt(
    begin: Callable[[str], Bench],
) -> None:
    bench = begin(few_images(8))
    room = board_room(bench)

    def spoil(exposure: int, picture: Picture) -> Picture:
        if exposure == 3:
            return np.zeros_like(picture)
        if exposure == 8:
            return np.full_like(picture, 90)
        return blurred(picture) if exposure == 10 else picture

    room.spoil = spoil
    state = bench.run()
    assert state.status == "completed"
    assert not bench.payloads(StepRetried)
    captured = bench.captured()
    replaced = [plan for plan in plans(bench) if plan["why"] == "replacement"]
    assert sum(len(plan["poses"]) for plan in replaced) == 3
    reasons = {name: why for plan in replaced for name, why in plan["instead_of"].items()}
    assert set(reasons) == {captured[2], captured[7], captured[9]}
    assert reasons[captured[2]] == "the image is black"
    assert "no board" in reasons[captured[7]]
    assert "blurred, its edges are" in reasons[captured[9]]
    assert len(captured) == 11
    assert state.steps["calibration"].measures["views"] == 8
    assert any(f"{captured[2]}: not used" in line for line in bench.operator.told)
    solved = state.steps["calibration"].result["details"]["intrinsics"]["images"]
    assert len(solved) == 8
    assert not set(reasons) & set(solved)


@pytest.mark.slow
def test_a_shortfall_is_mended_by_further_poses_and_all_others_are_kept(begin: Callable[[str], Bench]) -> None:
    few = PROTOCOL.replace("count: 14, coverage: 1.0", "count: 6, coverage: 0.3").replace(
        "views, min: 14", "views, min: 9"
    )
    bench = begin(few)
    board_room(bench)
    asked: list[str] = []

    def mend(question: Any, _state: Any) -> Any:
        asked.append(question.text)
        return answer(question, "confirm")

    bench.script("calibration", "recovery", mend, mend)
    state = bench.run()
    assert state.status == "completed"
    mends = [plan for plan in plans(bench) if plan["why"] == "mend"]
    assert len(mends) == len(asked) >= 1
    assert "coverage" in asked[0]
    assert f"Confirm to take {len(mends[0]['poses'])} more images of the board" in asked[0]
    captured = bench.captured()
    assert len(set(captured)) == len(captured), "nothing is taken twice"
    assert sorted(captured[6:]) == sorted(name for plan in mends for name in names(plan))
    first, *_, last = bench.payloads(GatesEvaluated)
    assert not first.passed
    assert last.passed


LISTED = """viewpoints:
        - station: station_1
          prefix: b
          rolls_deg: [0, 12, -12, 180, 168]
          aim_offset_m: [0, 0, 0.09]
          arcs:
            - {tilt_deg: 8, azimuth_from_deg: -60, azimuth_to_deg: 60, count: 2, distance_m: 0.8}
            - {tilt_deg: 30, azimuth_from_deg: -75, azimuth_to_deg: 75, count: 4, distance_m: 0.8}"""


@pytest.mark.slow
def test_a_board_seen_in_part_still_counts_when_further_poses_were_added(begin: Callable[[str], Bench]) -> None:
    listed = PROTOCOL.replace("board_poses: {station: station_1, prefix: b, count: 14, coverage: 1.0}", LISTED)
    only_views = [line for line in listed.splitlines() if "measure:" not in line or "views" in line]
    bench = begin("\n".join(only_views).replace("views, min: 14", "views, min: 8"))
    room = board_room(bench)

    def cover(exposure: int, picture: Picture) -> Picture:
        if exposure == 4:
            picture = picture.copy()
            picture[:, : picture.shape[1] // 2] = 90
        return picture

    room.spoil = cover
    bench.script("calibration", "recovery", lambda question, _state: answer(question, "confirm"))
    state = bench.run()
    assert state.status == "completed"
    first, last = bench.payloads(StepMeasured)
    assert first.measures["views_partial"] == last.measures["views_partial"] == 1
    assert first.measures["views"] == 7, "six listed, one of them in part, and its replacement"
    assert last.measures["views"] == 8
    planned = [line for line in bench.operator.told if "the kinematics of the arm are not known" in line]
    assert len(planned) >= 2, "listed poses and replacements are planned as others are, were the arm known"


@pytest.mark.slow
def test_the_board_on_its_other_side_stops_after_a_few_images(begin: Callable[[str], Bench]) -> None:
    bench = begin(few_images(6))
    room = board_room(bench)
    room.spoil = lambda exposure, picture: np.zeros_like(picture) if exposure <= 4 else picture
    texts: list[str] = []

    def uncover(question: Any, _state: Any) -> Any:
        texts.append(question.text)
        return answer(question, "confirm")

    bench.script("calibration", "recovery", uncover)
    state = bench.run()
    assert state.status == "completed"
    assert len(texts) == 1
    assert "the first images show no board" in texts[0]
    assert "the image is black" in texts[0]
    bench.must_verify()


@pytest.mark.slow
def test_a_smeared_lens_stops_the_capture_and_exactly_the_blurred_images_are_taken_again(
    begin: Callable[[str], Bench],
) -> None:
    bench = begin(few_images(12))
    room = board_room(bench)
    cleaned_after: list[int] = []
    room.spoil = lambda exposure, picture: blurred(picture) if exposure >= 7 and not cleaned_after else picture
    asked: list[str] = []

    def clean(question: Any, state: Any) -> Any:
        asked.append(question.text)
        assert [work.action for work in state.step.mend.hands] == ["clean_lens"]
        cleaned_after.append(bench.rig.shutter.exposures)
        return answer(question, "confirm")

    bench.script("calibration", "recovery", clean)
    state = bench.run()
    assert state.status == "completed"
    assert len(asked) == 1
    assert "Clean the lens, then confirm" in asked[0]
    captured = bench.captured()
    (stop,) = cleaned_after
    assert stop < 12, "no more images through a smeared lens than it takes to tell"
    bad = captured[6:stop]
    assert len(bad) >= 3
    assert sorted(name for name in set(captured) if captured.count(name) > 1) == sorted(bad)
    assert len(captured) == 12 + len(bad)
    assert not [plan for plan in plans(bench) if plan["why"] == "replacement"]
    bench.must_verify()


def blurred(picture: Picture) -> Picture:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 4.0), dtype=np.uint8)
