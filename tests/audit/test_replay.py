"""Replaying a run: equal if nothing changed; otherwise it shows where and by how much results differ."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from service.audit.differences import compare_data, compare_files
from service.audit.recorded_run import read_run
from service.audit.replay import ReplayReport, replay
from service.cli.main import app
from service.computations import job_kinds
from service.computations.job import Handler, JobAnswer, RecordedContext
from service.computations.records import SpheresFound
from service.core.errors import ComputeError, ConfigurationError, IntegrityError
from service.core.jobs import Reference, jobs_of, references_in, resolve
from service.core.records.base import ArtefactRef
from service.worker import loop
from tests.support.record.outsider import copy_data
from tests.support.runs.recorded_run import record_run

_locate_spheres = loop.HANDLERS["locate_spheres"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded run in the folder data."""
    made = tmp_path_factory.mktemp("recorded")
    record_run(made)
    return made


def again(folder: Path, **options: Any) -> ReplayReport:
    return replay(read_run(folder / "data", "latest"), progress=lambda _what, _done, _total: None, **options)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file except SQLite's temporary ones, which come and go with a connection."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(("-shm", "-wal")))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def hand(monkeypatch: pytest.MonkeyPatch, kind: str, handler: Handler) -> None:
    monkeypatch.setitem(loop.HANDLERS, kind, handler)


def moved_spheres(context: RecordedContext) -> JobAnswer:
    """As if the search for spheres had changed: every centre is shifted by 0.1 mm."""
    answer = _locate_spheres(context)
    spheres = [[x + 1e-4, y, z] for x, y, z in answer.result["spheres_m"]]
    measures = {**answer.measures, "sphere_change_max_mm": 0.4}
    return JobAnswer(measures, answer.artefacts, SpheresFound.model_validate({**answer.result, "spheres_m": spheres}))


@pytest.mark.slow
def test_the_same_again_bit_for_bit_and_nothing_written(folder: Path) -> None:
    before = contents(folder / "data")
    report = again(folder)
    assert report.verdict == "identical"
    assert [job.kind for job in report.jobs] == ["locate_spheres", "locate_spheres", "register"]
    assert all(job.verdict == "identical" and not job.differences for job in report.jobs)
    assert all(job.result.compared > 20 for job in report.jobs)
    assert [a.recorded_sha256 == a.recomputed_sha256 for a in report.jobs[2].artefacts] == [True]
    assert report.gates_judged == 3
    assert [gate.changed for gate in report.gates] == [(), (), ()]
    assert [(change.name, change.recorded) for change in report.versions] == [("numpy", "1.0.0-recorded")]
    assert contents(folder / "data") == before


@pytest.mark.slow
def test_a_job_of_an_earlier_version_is_named_with_both_versions(folder: Path) -> None:
    located, _, registered = again(folder).jobs
    assert registered.computed_by == (
        "computed by version 1 of the registration; this program has version 4, whose numbers differ or are more"
    )
    assert located.computed_by.startswith("computed by version 1 of the spheres in the mesh")
    assert job_kinds()["live_view"].other_numbers(1) == "", "versions up to 2 differ in their arguments alone"
    assert job_kinds()["register"].other_numbers(4) == ""
    assert "version 3" in job_kinds()["register"].other_numbers(3)
    told = CliRunner().invoke(app, ["replay", "latest", "--data", str(folder / "data")])
    assert "computed by version 1 of the registration" in " ".join(told.output.split())


def test_a_superseded_attempt_is_not_replayed(folder: Path) -> None:
    attempts = [job.attempt for job in again(folder, step="first_scan").jobs]
    assert attempts == [2]


def test_what_differs_is_named_and_measured(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hand(monkeypatch, "locate_spheres", moved_spheres)
    report = again(folder)
    assert report.verdict == "different"
    first, second, registered = report.jobs
    assert registered.verdict == "identical", "it is judged by itself, on the recorded spheres"
    (moved,) = [d for d in second.differences if d.path.startswith("result.spheres_m")]
    assert moved.difference == pytest.approx(0.1, abs=1e-6)
    assert (moved.unit, moved.values) == ("mm", 10)
    (change,) = [d for d in second.differences if d.path == "measures.sphere_change_max_mm"]
    assert change.difference == pytest.approx(0.4 - change.recorded)
    assert change.unit == "mm"
    assert first.verdict == "different"
    changed = {gate.step: gate.changed for gate in report.gates if gate.changed}
    ((old, new),) = changed["second_scan"]
    assert old.passed
    assert (new.value, new.passed) == (0.4, False)


@pytest.fixture(scope="module")
def referring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recorded run, with jobs that refer to earlier answers instead of copying them."""
    made = tmp_path_factory.mktemp("referring")
    record_run(made, version=2)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("recorded", ["folder", pytest.param("referring", marks=pytest.mark.sweep)])
def test_end_to_end_carries_the_change_to_the_registration(
    recorded: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder: Path = request.getfixturevalue(recorded)
    assert again(folder, end_to_end=True).drifts[0].against_cameras_mm == pytest.approx(0, abs=1e-9)
    hand(monkeypatch, "locate_spheres", moved_spheres)
    report = again(folder, end_to_end=True)
    assert report.jobs[2].verdict == "different"
    (drift,) = report.drifts
    # The scan's spheres moved by 0.1 mm in its own frame, so every camera moves by as much in it.
    assert drift.registration == "colmap"
    assert drift.against_cameras_mm == pytest.approx(0.1, abs=0.01)


@pytest.mark.slow
def test_a_job_that_refers_to_earlier_answers_holds_none_of_their_numbers(referring: Path) -> None:
    run = read_run(referring / "data", "latest")
    (first,), (second,), (registered,) = (tuple(state.jobs.values()) for state in run.state.steps.values())
    taken = {found.job for _, found in references_in(second.arguments) if isinstance(found, Reference)}
    assert taken == {first.job}
    assert len(json.dumps(registered.arguments["spheres_m"])) < 120
    assert resolve(registered.arguments, jobs_of(run.state))["spheres_m"] == second.result["spheres_m"]
    assert again(referring).verdict == "identical"


def test_rounding_is_equal_and_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = loop.HANDLERS["register"]

    def rounded(context: RecordedContext) -> JobAnswer:
        answer = usual(context)
        measures = {**answer.measures, "rms_px": answer.measures["rms_px"] * (1 + 1e-12)}
        return JobAnswer(measures, answer.artefacts, answer.answer)

    hand(monkeypatch, "register", rounded)
    report = again(folder, step="registration")
    assert report.verdict == "within_tolerance"
    (difference,) = report.jobs[0].differences
    assert difference.within_tolerance


def test_an_altered_input_file_is_named_before_anything_is_computed(folder: Path, tmp_path: Path) -> None:
    copy_data(folder / "data", tmp_path / "data")
    run = read_run(tmp_path / "data", "latest")
    (mesh, *_) = [a for a in run.artefacts if a.ref.kind == "scan_mesh"]
    path = run.files.artefact_path(mesh.ref.sha256)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(IntegrityError, match=mesh.ref.sha256[:12]):
        again(tmp_path)


def test_a_job_that_fails_now_could_not_be_replayed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(context: RecordedContext) -> JobAnswer:
        raise ComputeError("no answer")

    hand(monkeypatch, "register", refuse)
    report = again(folder)
    assert report.verdict == "not_replayed"
    assert [job.verdict for job in report.jobs] == ["identical", "identical", "not_replayed"]
    assert "no answer" in report.jobs[2].error


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"kinds": ["weigh"]}, "no worker computes weigh"),
        ({"step": "lunch"}, "no step 'lunch'"),
        ({"kinds": ["evaluate"]}, "nothing of these kinds"),
    ],
)
def test_what_cannot_be_asked(folder: Path, options: Mapping[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        again(folder, **options)


def test_recomputed_files_never_go_into_the_evidence(folder: Path) -> None:
    with pytest.raises(ConfigurationError, match="must not be written into the data folder"):
        again(folder, out=folder / "data" / "replayed")


# --- the command -------------------------------------------------------------------------------------------


def invoke(folder: Path, *words: str) -> Any:
    return CliRunner().invoke(app, ["replay", "latest", "--data", str(folder / "data"), *words])


def test_command_says_equal_with_status_0(folder: Path, tmp_path: Path) -> None:
    answer = invoke(folder, "--out", str(tmp_path / "out"))
    assert answer.exit_code == 0, answer.output
    assert "equal, bit for bit" in answer.output
    assert "numpy 1.0.0-recorded →" in answer.output
    report = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert report["verdict"] == "identical"
    (kept,) = (tmp_path / "out" / "registration").rglob("colmap.json")
    recorded = next(a for a in read_run(folder / "data", "latest").artefacts if a.ref.original_name == "colmap.json")
    files = read_run(folder / "data", "latest").files
    assert kept.read_bytes() == files.artefact_path(recorded.ref.sha256).read_bytes()


@pytest.mark.slow
def test_command_says_where_and_by_how_much_with_status_1(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hand(monkeypatch, "locate_spheres", moved_spheres)
    answer = invoke(folder, "--jobs", "locate_spheres")
    assert answer.exit_code == 1, answer.output
    assert "result.spheres_m" in answer.output
    assert "0.1 mm" in answer.output
    assert "these differ (1)" in answer.output
    plain = json.loads(invoke(folder, "--jobs", "locate_spheres", "--json").stdout)
    assert plain["verdict"] == "different"
    assert any(d["path"].startswith("result.spheres_m") for d in plain["jobs"][0]["differences"])


def test_command_that_cannot_ends_with_status_2(folder: Path, tmp_path: Path) -> None:
    answer = invoke(folder, "--jobs", "weigh", "--json")
    assert answer.exit_code == 2
    assert json.loads(answer.stdout)["error"]["kind"] == "ConfigurationError"
    assert invoke(tmp_path).exit_code == 2


# --- comparing ---------------------------------------------------------------------------------------------


def test_units_follow_from_names() -> None:
    old: dict[str, Any] = {
        "T_world_scan": np.eye(4).tolist(),
        "centres_m": [[1.0, 2.0, 3.0]],
        "rms_px": 0.5,
        "tilt_rad": 0.1,
    }
    new: dict[str, Any] = {
        "T_world_scan": np.eye(4).tolist(),
        "centres_m": [[1.0, 2.0, 3.002]],
        "rms_px": 0.75,
        "tilt_rad": 0.2,
    }
    new["T_world_scan"][1][3] = 0.003
    found = {d.path.split("[")[0]: d for d in compare_data(old, new).differences}
    assert (found["T_world_scan translation"].difference, found["T_world_scan translation"].unit) == (3.0, "mm")
    assert found["centres_m"].difference == pytest.approx(2.0)
    assert (found["rms_px"].difference, found["rms_px"].unit) == (0.25, "px")
    assert found["tilt_rad"].difference == pytest.approx(np.degrees(0.1))
    assert found["tilt_rad"].unit == "°"


def test_what_is_missing_or_of_another_kind_is_a_difference() -> None:
    found = compare_data({"a": 1, "b": [1, 2], "c": "x", "d": True}, {"b": [1], "c": "y", "d": 1, "e": None})
    assert {d.path for d in found.differences} == {"a", "b", "c", "d", "e"}
    assert not found.equal
    assert compare_data({"a": 1}, {"a": 1.0}).identical, "JSON has one kind of number"


def test_another_wording_of_an_explanation_is_told_and_is_no_other_result() -> None:
    old = {"contributions": [{"name": "outlines", "how": "what they have in common", "sigma_mm": 0.01}]}
    new = {"contributions": [{"name": "outlines", "how": "errors that they share", "sigma_mm": 0.01}]}
    found = compare_data(old, new)
    assert [d.path for d in found.differences] == ["contributions[0].how"]
    assert found.equal
    assert not found.identical
    assert not compare_data({"name": "outlines"}, {"name": "poses"}).equal
    assert not compare_data({"how": "by hand"}, {"how": 1}).equal


def test_many_entries_by_name_are_one_field() -> None:
    old = {"views": {f"v{n}": [1.0, float(n)] for n in range(20)}}
    new = {"views": {f"v{n}": [1.0, n + 0.001 * n] for n in range(20)}}
    (difference,) = compare_data(old, new).differences
    assert difference.values == 19


def test_pictures_and_arrays_by_content(tmp_path: Path) -> None:
    def ref(name: str, media_type: str) -> ArtefactRef:
        return ArtefactRef(sha256="0" * 64, kind="x", media_type=media_type, size_bytes=1, original_name=name)

    picture = np.full((4, 6, 3), 100, np.uint8)
    for name, change in (("a", 0), ("b", 3)):
        picture[1, 2, 0] = 100 + change
        (tmp_path / f"{name}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
        np.savez(tmp_path / f"{name}.npz", vertices_m=np.array([[0.0, 1.0 + change / 1000]]))
    (pixel,) = compare_files(ref("o.png", "image/png"), tmp_path / "a.png", tmp_path / "b.png").differences
    assert (pixel.difference, pixel.values) == (3.0, 1)
    (vertex,) = compare_files(ref("m.npz", "application/x-npz"), tmp_path / "a.npz", tmp_path / "b.npz").differences
    assert vertex.difference == pytest.approx(3.0)
    assert vertex.unit == "mm"
