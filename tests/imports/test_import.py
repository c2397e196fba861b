"""`orthocapture import`: a folder becomes an imported run, interrupted or not; odd files are left out."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml
from typer.testing import CliRunner

from service.cli.demo import true_error_mm
from service.cli.main import app
from service.core.errors import DataError
from service.core.protocol import load_protocol
from service.core.records.import_list import FileRole, PhotographRole
from service.core.records.run_events import (
    OperatorAction,
    RecordedOptics,
    RunStarted,
    ViewImported,
    ViewpointCaptured,
)
from service.dataset.exporter import exporter, write_data_set
from service.dataset.run_data_set import data_set_of
from service.dataset.summary import summarise
from service.import_folder import CtReading, find_places, import_rig, list_import
from service.run_start import recorded_rig, recorded_run, start_run
from service.steps import params_models
from service.steps.kinds.image_import import stated_settings_agree
from service.store.database.engine import database_path
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import web_site
from tests.support.processes.forked import Forked
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, command, orthocapture
from tests.support.runs.import_folder import Photographer, around, over_the_board

PARTS: frozenset[PhotographRole | FileRole] = frozenset(
    ("calibration", "image", "control_image", "scan", "control_scan", "ct")
)
PROTOCOL = REPOSITORY / "protocols" / "import_spine.yaml"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tiny photographs, two of them of the board, and a file named like a scan: only for listing."""
    folder = tmp_path_factory.mktemp("import") / "small"
    photographer = Photographer(folder, 240)
    photographer.photographs("calibration", over_the_board(2), board=True)
    photographer.photographs("images", around(2))
    photographer.ct()
    (folder / "scan").mkdir()
    (folder / "scan" / "scan.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    return folder


@pytest.fixture
def folder(small: Path, tmp_path: Path) -> Path:
    """A copy to modify."""
    return Path(shutil.copytree(small, tmp_path / "brought"))


def listed(folder: Path, first_number: int = 1) -> Any:
    return list_import(find_places(folder, {}, PARTS), ct=CtReading(first_number))


def left_out(folder: Path) -> dict[str, str]:
    return {one.path: one.reason for one in listed(folder).left_out}


def refusal(*words: str) -> str:
    result = CliRunner().invoke(app, ["import", *words, "--specimen", "S1", "--json"], catch_exceptions=False)
    assert result.exit_code == 1, result.output
    error = json.loads(result.output.splitlines()[-1])["error"]
    return f"{error['what']} {error['where']} {error['remedy']}"


@pytest.mark.slow
def test_odd_files_are_left_out_by_name_with_the_reason(folder: Path) -> None:
    images = folder / "images"
    first, second = sorted(images.glob("*.JPG"))
    (images / "._DSC00003.JPG").write_bytes(b"\0\5\26\7")
    (images / "Thumbs.db").write_bytes(b"x")
    (images / "clip.mp4").write_bytes(b"x")
    (images / "thumbnails").mkdir()
    shutil.copy(first, images / "thumbnails" / "small.jpg")
    shutil.copy(first, images / f"{first.stem} (1).JPG")
    (images / "raw").mkdir()
    (images / "raw" / f"{second.stem}.ARW").write_bytes(b"II*\0")
    (images / "lonely.arw").write_bytes(b"II*\0")
    (folder / "notes.txt").write_text("hello")
    picture = cv2.imread(str(first))
    assert picture is not None
    cv2.imwrite(str(images / "DSC00021.JPG"), cv2.resize(picture, (160, 107)))
    reasons = left_out(folder)
    assert reasons.keys() == {
        "images/._DSC00003.JPG", "images/Thumbs.db", "images/clip.mp4", "images/thumbnails/small.jpg",
        f"images/{first.stem} (1).JPG", "images/lonely.arw", "notes.txt", "images/DSC00021.JPG",
    }  # fmt: skip
    assert "same bytes as images/DSC00003.JPG" in reasons[f"images/{first.stem} (1).JPG"]
    assert "160 × 107 px, most are 240 × 160" in reasons["images/DSC00021.JPG"]
    views = {view.name: view for view in listed(folder).of("image")}
    assert [raw.path for raw in views[second.stem].raws] == [f"images/raw/{second.stem}.ARW"]
    assert views[first.stem].camera["lens"] == "FE 24-70mm F2.8 GM"
    assert views[first.stem].camera["exif_time"].startswith("2024:03:01 10:03")


@pytest.mark.slow
def test_a_picture_of_another_kind_is_named_and_the_import_goes_on(folder: Path) -> None:
    heic = folder / "images" / "DSC00099.JPG"
    heic.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200))
    assert left_out(folder)["images/DSC00099.JPG"] == "this is a HEIC picture, not JPEG"
    assert len(listed(folder).of("image")) == 2


def test_damaged_photographs_are_an_error_that_names_them_all(folder: Path, tmp_path: Path) -> None:
    for path in (folder / "images").glob("*.JPG"):
        path.write_bytes(path.read_bytes()[:-2000])
    text = refusal(str(folder), "--data", str(tmp_path / "data"))
    assert "2 photographs are damaged" in text
    assert "DSC00003.JPG" in text
    assert "DSC00004.JPG" in text
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_what_the_protocol_needs_must_be_there(folder: Path) -> None:
    shutil.rmtree(folder / "scan")
    assert "the protocol needs scan" in refusal(str(folder), "--dry-run")
    shutil.rmtree(folder / "calibration")
    assert "--calibration-images" in refusal(str(folder), "--dry-run")
    assert "there is no such place for ct" in refusal(str(folder), "--ct", "nowhere", "--dry-run")


@pytest.mark.slow
def test_nobody_imports_in_the_name_of_an_account_without_its_password(folder: Path, tmp_path: Path) -> None:
    with web_site(tmp_path):
        pass
    words = ["--data", str(tmp_path / "data"), "--operator", "emmy", "--password-stdin"]
    assert "name and password do not belong together" in refusal(str(folder), *words)
    with Store.open(tmp_path / "data") as store:
        assert store.runs() == []


@pytest.mark.slow
def test_one_whole_series_is_the_ct(folder: Path) -> None:
    slices = sorted((folder / "ct").glob("*.dcm"))
    assert [file.path for file in listed(folder).files["ct"]] == [f"ct/{path.name}" for path in slices]
    slices[len(slices) // 2].unlink()
    assert "no complete CT series" in refusal(str(folder), "--dry-run")


@pytest.mark.slow
def test_a_series_whose_first_slices_are_missing_is_taken_only_on_purpose(folder: Path, tmp_path: Path) -> None:
    first, second, *rest = sorted((folder / "ct").glob("*.dcm"))
    for path in (first, second):
        path.unlink()
    assert f"numbered 3 to {len(rest) + 2}, not from 1" in refusal(str(folder), "--dry-run")
    words = ["import", str(folder), "--dry-run", "--ct-first-number", "3", "--json"]
    shown = CliRunner().invoke(app, words, catch_exceptions=False)
    assert len(json.loads(shown.output)["files"]["ct"]) == len(rest)
    rig = import_rig(listed(folder, 3), simulated=True, ct=CtReading(3))
    assert rig.section.devices["ct"]["first_number"] == 3


def test_a_file_that_changed_since_it_was_listed_is_refused(folder: Path) -> None:
    listing = listed(folder)
    path = listing.absolute(listing.of("image")[0].photograph)
    assert listing.check(path, listing.of("image")[0].photograph.sha256).path == "images/DSC00003.JPG"
    with pytest.raises(DataError, match="changed since it was listed"):
        listing.check(path, "0" * 64)
    with pytest.raises(DataError, match="not in the list"):
        listing.check(str(folder / "notes.txt"), "0" * 64)


def test_equal_names_in_several_folders_stay_apart(folder: Path) -> None:
    (folder / "images" / "side").mkdir()
    shutil.move(folder / "images" / "DSC00004.JPG", folder / "images" / "side" / "DSC00003.JPG")
    assert {view.name for view in listed(folder).of("image")} == {"image_DSC00003", "image_side_DSC00003"}


@pytest.mark.slow
def test_a_dry_run_shows_and_records_nothing(folder: Path, tmp_path: Path) -> None:
    words = ["import", str(folder), "--dry-run", "--data", str(tmp_path / "data")]
    shown = CliRunner().invoke(app, words, catch_exceptions=False)
    assert shown.exit_code == 0, shown.output
    assert "2024-03-01" in shown.output
    record = json.loads(CliRunner().invoke(app, [*words, "--json"]).output)
    assert record["photographs"]["image"]["count"] == 2
    assert record["photographs"]["image"]["sizes"] == ["240 × 160"]
    assert not (tmp_path / "data").exists()


def test_settings_are_judged_where_protocol_and_file_state_them() -> None:
    wanted = load_protocol(REPOSITORY / "protocols" / "demo.yaml", params_models()).protocol.camera
    assert stated_settings_agree(RecordedOptics(aperture_f=22.0, exposure_s=1 / 15, iso=100), wanted) is True
    assert stated_settings_agree(RecordedOptics(aperture_f=8.0), wanted) is False
    assert stated_settings_agree(RecordedOptics(), wanted) is None
    assert stated_settings_agree(RecordedOptics(aperture_f=8.0), None) is None


def test_the_list_is_the_rig_of_the_run_and_names_the_interrupted_one(folder: Path, tmp_path: Path) -> None:
    loaded = load_protocol(PROTOCOL, params_models())
    rig = import_rig(listed(folder), simulated=True)
    assert rig.source == import_rig(listed(folder), simulated=True).source
    with Store.open(tmp_path / "data") as store:
        run = start_run(store, loaded, rig, operator="Ada", auto_confirm=False)
        root = store.events(run)[0].payload
        assert isinstance(root, RunStarted)
        assert root.origin == "imported"
        assert recorded_rig(store, root).section == rig.section


# --- whole runs --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Photographer]:
    """A folder with everything but a CT."""
    folder = tmp_path_factory.mktemp("import") / "spine"
    photographer = Photographer(folder, 960)
    photographer.photographs("calibration", over_the_board(9), board=True)
    photographer.photographs("control", around(2, turn=0.1))
    photographer.control_spheres = False
    photographer.photographs("images", around(8))
    photographer.scan("control_scan", control_spheres=True, nth=1)
    photographer.scan("scan", control_spheres=False, nth=2)
    return folder, photographer


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The protocol with one kind of structure from motion, and without the CT, which the folder lacks."""
    protocol = yaml.safe_load(PROTOCOL.read_text())
    steps = {step["id"]: step for step in protocol["steps"]}
    steps["registration"]["params"] |= {"poses": ["colmap"]}
    steps["registration"]["params"]["structure_from_motion"] = {"max_image_size": 960, "max_features": 3000}
    for name, measure in (("calibration_images", "images_imported"), ("camera_calibration", "views")):
        next(g for g in steps[name]["gates"] if g["measure"] == measure)["min"] = 6
    path = tmp_path_factory.mktemp("protocol") / "import.yaml"
    path.write_text(yaml.safe_dump(protocol, sort_keys=False))
    return path


def error_mm(data: Path, run: str, photographer: Photographer) -> float:
    """Error of the registration at the centre of the spheres, against the true camera poses."""
    with Store.open(data) as store:
        summary = summarise(store, run, recorded_run(store, run)[0])
        cameras = summary.registrations()["colmap"].T_scan_camera
        spheres_m = summary.scan_spheres_m()
    return true_error_mm(cameras, photographer.T_world_camera, photographer.T_world_scan, spheres_m)


@pytest.mark.slow
@pytest.mark.whole
@pytest.mark.timeout(900)
def test_an_import_killed_and_begun_again_is_a_run_that_says_so_everywhere(
    spine: tuple[Path, Photographer], short: Path, tmp_path: Path
) -> None:
    folder, photographer = spine
    data = tmp_path / "data"
    words = ["import", str(folder), "--protocol", str(short), "--simulated", "--operator", "Ada", "--specimen", "S1"]
    words += ["--data", str(data)]
    process = Forked(
        command(*words),
        cwd=REPOSITORY,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )

    def begun() -> bool:
        assert process.poll() is None
        return bool(imported_so_far(data))

    until(begun, "nothing is imported", 600, every_s=0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = imported_so_far(data)
    answer = orthocapture(*words, "--json", timeout_s=800)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    result = json.loads(answer.stdout.splitlines()[-1])
    assert result["status"] == "completed"
    assert result["table"][0]["evaluated_on"] == "control spheres"
    with Store.open(data) as store:
        assert [row.run_id for row in store.runs()] == [result["run"]]
        payloads = [event.payload for event in store.events(result["run"])]
        views = [p for p in payloads if isinstance(p, ViewImported)]
        assert [view.artefacts[0].sha256 for view in views][: len(before)] == before
        assert len({view.artefacts[0].sha256 for view in views}) == len(views) == 19
        assert {view.imported_by for view in views} == {"Ada"}
        assert not any(isinstance(p, ViewpointCaptured) for p in payloads)
        skipped = [p for p in payloads if isinstance(p, OperatorAction) and p.action == "skip"]
        assert [(p.step, p.reason) for p in skipped] == [("ct", "no CT series among the files")]
        summary = summarise(store, result["run"], recorded_run(store, result["run"])[0])
        write_data_set(data_set_of(summary), exporter("plain"), tmp_path / "dataset")
    assert error_mm(data, result["run"], photographer) < 0.3
    assert verify(data, result["run"]).ok
    again = orthocapture(*words, "--json")
    assert "imported before" in json.loads(again.stdout.splitlines()[-1])["error"]["what"]
    real = orthocapture(*[word for word in words if word != "--simulated"], "--json")
    assert "made by simulators" in json.loads(real.stdout.splitlines()[-1])["error"]["what"]
    says_so(data, result["run"], tmp_path)  # with an account, whose name needs its password from then on


def imported_so_far(data: Path) -> list[str]:
    """Hashes of the recorded photographs, of a run that may still be written."""
    if not database_path(data).is_file():
        return []
    with Store.open(data, create=False) as store:
        events = [event for row in store.runs() for event in store.events(row.run_id)]
    return [event.payload.artefacts[0].sha256 for event in events if isinstance(event.payload, ViewImported)]


def says_so(data: Path, run: str, folder: Path) -> None:
    """Check report, data set and replay of an import."""
    words = "how the images were captured is not in evidence"
    description = json.loads((folder / "dataset" / "dataset.json").read_text())
    assert description["origin"] == "imported"
    assert words in description["origin_in_words"]
    report = folder / "report.html"
    answer = orthocapture("audit", "report", run, "--html", str(report), "--data", str(data), timeout_s=300)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert words in report.read_text()
    with web_site(folder) as site:
        browser = site.browser("auditor")
        for page in ("", "/capture", "/scene", "/calibration", "/calibration/certificate"):
            answered = browser.get(f"/runs/{run}{page}")
            assert (answered.status_code, words in answered.text) == (200, True), page
        first = browser.get(f"/audit/runs/{run}")
        assert (first.status_code, words in first.text) == (200, True)
