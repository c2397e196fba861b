"""The report of a run, in HTML and PDF: what it states, and that it never hides a fault."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import zipfile
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.audit.bundle import export_bundle
from service.audit.recorded_run import read_run
from service.audit.report import incidents, report_content
from service.audit.report_blocks import Report
from service.audit.report_output import render_html
from service.cli.main import app
from service.core.errors import StoreError
from service.core.records.events import Event
from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    EvidenceExported,
    LeaveLapsed,
    RobotSeen,
    RunReleased,
)
from service.people.sessions import People
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, password_of
from tests.support.record.outsider import copy_data
from tests.support.recorded import reported_run
from tests.support.recorded.reported_run import record_reported_run
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store

AT = datetime(2026, 11, 21, 11, 30, tzinfo=UTC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A signed run with deviations, in the folder data."""
    made = tmp_path_factory.mktemp("reported")
    run_id = record_reported_run(made)
    with Store.open(made / "data") as store:
        checkpoint(store, run_id)
    return made


def report_of(data: Path, **options: Any) -> Report:
    run_id = read_run(data, "latest").run_id
    return report_content(read_run(data, run_id), verify(data, run_id), made_at=AT, **options)


@pytest.fixture(scope="module")
def report(folder: Path) -> Report:
    return report_of(folder / "data")


class _Words(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_data(self, data: str) -> None:
        self.found.append(data)


def words_of(html: str) -> str:
    """The text between the tags, in order, with white space normalised."""
    parser = _Words()
    parser.feed(html)
    return " ".join(" ".join(parser.found).split())


# --- what it says -----------------------------------------------------------------------------------------


def test_first_page_says_what_nobody_may_miss(report: Report) -> None:
    html = words_of(render_html(report))
    first = html[: html.index("Contents")]
    for text in (
        "SIMULATED",
        "The evidence verifies",
        "deviations, listed first",
        "0.213 mm, within the limit of 0.35 mm (the protocol's gate)",
        "predicted uncertainty of the registration of 0.040 mm (1σ, 3D), 0.061 mm with the scan's own error",
        "Ada Λ. Müller",
        "reported, version 3",
        report.head_sha256,
    ):
        assert text in first, text


def test_deviations_come_before_everything_else(report: Report) -> None:
    assert report.sections[0].title == "Deviations"
    html = words_of(render_html(report))
    section = html[html.index(" 1 Deviations") : html.index(" 2 Registration error")]
    for text in (
        "attempt 1: Viewpoints captured 1 view, allowed ≥ 2",
        "v002 given up: no file arrived",
        "the cable was loose",
        "camera: the camera does not answer",
        "environment.light_lux: 0 → 800",
        "the meter was covered",
        "Replaced by later ones: attempts at steps 1, single views 0.",
    ):
        assert text in section, text


def test_signature_certificate_devices_and_verification(folder: Path, report: Report) -> None:
    html = words_of(render_html(report))
    run = read_run(folder / "data", "latest")
    certificate = next(a.ref.sha256 for a in run.artefacts if a.ref.kind == "calibration")
    (key,) = verify(folder / "data", run.run_id).key_ids
    for text in (
        f"Evaluate: reviewed and accepted (cli) {run.state.steps['evaluation'].gates_sha256}",
        f"Certificate number (SHA-256 of calibration.json) {certificate}",
        "0.0300 px rms, which is 0.0120 mm at 0.70 m (5 folds)",
        "0.040 mm (median over the views, each predicted by the others)",
        "Any of these makes a new one necessary",
        "95% of the 96 cells hold a corner (empty: 1)",
        "1.10 / 11.53 (1920)",
        "UR10e 20231 5.12",
        "stayed within 0.0 ms",
        "light 800 to 800 lx, temperature 21.5 to 21.5 °C",
        "Signed checkpoints (Ed25519) 1",
        key,
        "Part 11-style controls",
    ):
        assert text in html, text
    assert "complian" not in html.lower()


def test_outside_its_limit_it_says_so(tmp_path: Path) -> None:
    record_reported_run(tmp_path, error_mm=0.3499999)
    assert report_of(tmp_path / "data").result.tone == "ok"
    shutil.rmtree(tmp_path / "data")
    record_reported_run(tmp_path, error_mm=0.41)
    report = report_of(tmp_path / "data")
    assert "OUTSIDE the limit" in report.result.text
    assert report.result.tone == "stop"
    html = words_of(render_html(report))
    assert "Mean radial error of the registration used 0.41 mm, allowed ≤ 0.35" in html
    assert "the step is recovering" in html


def test_a_displaced_control_sphere_and_contradicting_inputs_are_said_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, found = reported_run.evaluation, reported_run.registration_record
    moved = "control sphere 1 is 8.00 mm from where scan and registration put it"
    spheres = [
        {"index": 0, "expected": 18, "measured": 18, "radial_error_mm": 0.03},
        {"index": 1, "expected": 18, "measured": 17, "radial_error_mm": 2.37, "displacement_mm": 8.0,
         "displacement_sigma_mm": 0.02, "finding": moved},
    ]  # fmt: skip

    def evaluation(error_mm: float) -> dict[str, Any]:
        result = plain(error_mm)
        result["table"][0]["control_spheres"] = spheres
        return result

    def registration(*arguments: Any, **fields: Any) -> dict[str, Any]:
        one = {"kind": "image left out", "what": "v003 is left out", "remedy": "Check its pose"}
        return {**found(*arguments, **fields), "findings": [one]}

    monkeypatch.setattr(reported_run, "evaluation", evaluation)
    monkeypatch.setattr(reported_run, "registration_record", registration)
    record_reported_run(tmp_path, registered=True)
    html = words_of(render_html(report_of(tmp_path / "data")))
    for text in ("Control sphere 1 is 8.00 mm from where", "17 of 18", "2.370", "v003 is left out. Check its pose."):
        assert text in html, text


def test_evidence_that_does_not_verify_is_said_first_and_loudest(folder: Path, tmp_path: Path) -> None:
    copy_data(folder / "data", tmp_path / "data")
    run = read_run(tmp_path / "data", "latest")
    photograph = next(a for a in run.artefacts if a.ref.kind == "image" and a.attempt == 2)
    path = run.files.artefact_path(photograph.ref.sha256)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    report = report_of(tmp_path / "data")
    assert report.verification.tone == "stop"
    html = words_of(render_html(report))
    assert html.index("THE EVIDENCE DOES NOT VERIFY") < html.index(" 1 Deviations")
    assert f"{photograph.viewpoint}: the file is missing or was altered" in html
    answer = CliRunner().invoke(
        app, ["audit", "report", "--data", str(tmp_path / "data"), "--pdf", str(tmp_path / "r.pdf"), "--json"]
    )
    assert answer.exit_code == 1
    assert json.loads(answer.stdout)["verified"] is False
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")


def test_a_camera_has_one_serial_number_and_clocks_are_explained(tmp_path: Path) -> None:
    record_reported_run(tmp_path, serials=("3282933005318008", "05318008"))
    html = words_of(render_html(report_of(tmp_path / "data")))
    assert "camera ILCE-7RM5 05318008 3.00" in html
    assert "body 05318008, FE 50mm" not in html, "the certificate's images are the calibration's own"
    assert html.count("3282933005318008") == 1
    assert "which ends with the same digits: it is one and the same body" in html
    assert "1279.000 s behind this machine's" in html
    assert "✗ beyond It sets the times in the device's own files" in html
    assert "so its distance from this machine's clock means nothing" in html


def test_counts_are_in_the_singular_where_there_is_one(tmp_path: Path) -> None:
    record_reported_run(tmp_path)
    html = words_of(render_html(report_of(tmp_path / "data")))
    assert "3 photographs taken: 2 in use, 1 replaced by later ones; 1 exposure failed" in html
    assert not re.findall(
        r"\b(?<![\d.,])1 (?:deviations|faults|events|views|images|photographs|exposures|jobs)\b", html
    )


def test_the_contents_lead_to_every_section(report: Report) -> None:
    html = render_html(report)
    for number, section in enumerate(report.sections, 1):
        assert f'<li><a href="#section-{number}">{section.title}</a></li>' in html
        assert f'<h2 id="section-{number}">{number} {section.title}</h2>' in html
    assert 'content: "Page " counter(page) " of " counter(pages)' in html


def test_specimen_and_site_stand_first(report: Report) -> None:
    assert [name for name, _ in report.facts.rows[:4]] == ["Specimen", "Site", "Rig", "Run"]
    assert dict(report.facts.rows)["Rig"] == "small"


def test_originals_are_named_by_their_hash(folder: Path, report: Report) -> None:
    html = words_of(render_html(report))
    run = read_run(folder / "data", "latest")
    originals = [a for a in run.artefacts if a.ref.kind == "image" and a.attempt == 2]
    assert len(originals) == 2
    for artefact in originals:
        assert f"{artefact.seq} {artefact.viewpoint} {artefact.ref.original_name} {artefact.ref.sha256}" in html


# --- how it is written -----------------------------------------------------------------------------------


def test_html_needs_nothing_from_elsewhere_and_lets_nothing_in(tmp_path: Path) -> None:
    record_reported_run(tmp_path, person="<script>alert(1)</script>")
    html = render_html(report_of(tmp_path / "data"))
    assert "&lt;script&gt;alert(1)" in html
    assert "<script" not in html, "no scene in this run, so no script at all"
    assert not re.search(r'(src|href)="(?!data:|#section-)', html)
    assert html.count("data:image/jpeg;base64,") == 2


def test_the_same_evidence_gives_the_same_bytes(folder: Path, report: Report) -> None:
    assert render_html(report_of(folder / "data")) == render_html(report)


def test_command_writes_both(folder: Path, tmp_path: Path) -> None:
    pdf, html = tmp_path / "r.pdf", tmp_path / "r.html"
    words = ["audit", "report", "latest", "--data", str(folder / "data"), "--pdf", str(pdf), "--html", str(html)]
    before = sorted((p, p.stat().st_mtime_ns) for p in (folder / "data" / "artefacts").rglob("*"))
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 0, answer.output
    assert pdf.read_bytes().startswith(b"%PDF-")
    assert html.read_text().startswith("<!doctype html>")
    assert sorted((p, p.stat().st_mtime_ns) for p in (folder / "data" / "artefacts").rglob("*")) == before


def test_command_records_what_leaves_before_it_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_id = record_reported_run(tmp_path)
    data, html = tmp_path / "data", tmp_path / "r.html"
    words = ["audit", "report", "--data", str(data), "--html", str(html), "--json", "--operator", "Grace"]

    def told() -> list[Event]:
        return [e for e in read_run(data, run_id).events if isinstance(e.payload, EvidenceExported)]

    with monkeypatch.context() as patched:
        patched.setattr(Store, "record", _refuse)
        answer = CliRunner().invoke(app, words)
        assert answer.exit_code == 1
        assert "no space" in answer.output
        assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "rig.yaml"]
        with Store.open(data) as store, pytest.raises(StoreError, match="no space"):
            export_bundle(store, run_id, tmp_path / "b.zip", actor="ada")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "rig.yaml"]
    head = read_run(data, run_id).events[-1].sha256
    answer = CliRunner().invoke(app, words)
    assert json.loads(answer.stdout)["recorded"] is True
    (event,) = told()
    assert event.actor == "Grace"
    assert isinstance(event.payload, EvidenceExported)
    assert (event.payload.what, event.payload.file_name, event.payload.head_sha256) == ("report", "r.html", head)
    assert event.payload.sha256 == hashlib.sha256(html.read_bytes()).hexdigest()
    assert head in html.read_text()
    monkeypatch.setattr("service.cli.audit._writable", lambda _data: False)  # a copy on a read-only medium
    assert json.loads(CliRunner().invoke(app, words).stdout)["recorded"] is False
    assert len(told()) == 1
    assert verify(data, run_id).ok


def _refuse(*_arguments: object, **_more: object) -> None:
    raise StoreError("no space")


def test_people_are_named_in_full(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, person="ada")
    with Store.open(tmp_path / "data") as store:
        accounts = People(store, QUICK_HASHES).accounts
        token = accounts.first_link()
        assert token is not None
        accounts.set_up(token, "ada", "Ada, Countess of Lovelace", password_of("ada"), PIN)
        bundle = export_bundle(store, run_id, tmp_path / "b.zip", actor="ada").path
    html = words_of(render_html(report_of(tmp_path / "data")))
    assert html.count("Ada, Countess of Lovelace (ada)") >= 3
    with zipfile.ZipFile(bundle) as archive:
        crate = json.loads(archive.read("ro-crate-metadata.json"))
    (person,) = (entity for entity in crate["@graph"] if entity["@type"] == "Person")
    assert (person["name"], person["alternateName"]) == ("Ada, Countess of Lovelace", "ada")


def test_without_its_release_a_run_is_marked(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, release="second_person")
    html = render_html(report_of(tmp_path / "data"))
    assert '<p class="simulated">NOT RELEASED<small>The protocol asks' in html
    with Store.open(tmp_path / "data") as store:
        released = RunReleased(meaning="read", signed_sha256=store.events(run_id)[-1].sha256)
        store.record(run_id, [released], actor="grace")
    html = render_html(report_of(tmp_path / "data"))
    assert "NOT RELEASED" not in html
    assert "Released by a second person: grace" in html


def test_command_without_a_file_says_what_to_say(folder: Path) -> None:
    answer = CliRunner().invoke(app, ["audit", "report", "--data", str(folder / "data"), "--json"])
    assert answer.exit_code == 1
    assert "--pdf FILE" in json.loads(answer.stdout)["error"]["remedy"]


def test_a_lost_arm_who_looked_at_it_and_a_confirmation_that_lapsed_are_listed(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        run = begin_run(store, PROTOCOL, tmp_path).run_id
        opened = DeviceOpened(device="robot", report={"identity": {"kind": "robot"}})
        lost = DeviceTrouble(device="robot", error="DeviceUnavailableError", message="no answer", connection="died")
        *_, trouble = store.record(run, [opened, lost], actor="runner")
        store.record(run, [RobotSeen(device="robot", lost_seq=trouble.seq)], actor="Ada")
        lapsed = LeaveLapsed(leave_seq=1, idle_s=61.0, limit_s=60.0, why="no file")
        store.record(run, [lapsed], actor="runner")
    told = {one.kind: (one.text, one.who) for one in incidents(read_run(tmp_path / "data", "latest"))}
    assert told["device"] == ("robot: no answer", "runner")
    assert told["arm looked at"] == ("robot: somebody looked at it after its connection was lost", "Ada")
    held = "no visible progress for 61 s, a confirmation holds for 60 s: no file"
    assert told["confirmation lapsed"] == (held, "runner")
