"""The purpose and identity of a run, and notes on its steps: entered, recorded, verified, shown and found again."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Generator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from service.audit import bundle_verifier
from service.audit.bundle import export_bundle
from service.audit.filters import RunSearch
from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import render_html, write_pdf
from service.audit.runs import find_runs
from service.cli.main import app
from service.core.records.entered import NoteTaken, RunAbout
from service.core.records.events import PAYLOAD
from service.core.records.run_events import RunAborted, RunStarted
from service.store.signatures.signing import checkpoint
from service.store.verification.verify import verify
from tests.support.pages.browsed_run import words
from tests.support.pages.web import Browser, WebSite, password_of, web_site
from tests.support.rig.rig import REPOSITORY
from tests.support.runs.bench_run import PROTOCOL

ENTERED = {
    "specimen": "Spine 7, L1–L5",
    "purpose": "Pilot of the <new> lens",
    "site": "Balgrist, room 4",
    "operator": "Grace Hopper and a student",
    "text": "Thawed at 07:30.\r\nSecond try.",
}


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def typed(*arguments: str, said: str = "") -> Result:
    """Run a command line to its end."""
    return CliRunner().invoke(app, list(arguments), input=said)


def jpeg(width: int = 640, height: int = 480) -> bytes:
    rng = np.random.default_rng(3)
    pixels = cv2.GaussianBlur(rng.integers(0, 255, (height, width, 3), np.uint8), (0, 0), 8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def start(browser: Browser, **fields: str) -> str:
    """Begin a run through the form; returns its id."""
    answer = browser.send_form("/runs", protocol="bench.yaml", **{**ENTERED, **fields})
    assert answer.status_code == 303, answer.text
    return answer.headers["location"].removeprefix("/runs/")


def note(
    browser: Browser,
    run_id: str,
    text: str = "",
    photograph: bytes | None = None,
    step: str = "",
    name: str = "n.jpg",
) -> httpx.Response:
    """Write a note through the dialog's form."""
    fields = {"csrf": browser.person.csrf, "text": text, "step": step}
    files = {"photograph": (name, photograph or b"", "image/jpeg")} if photograph is not None else None
    return browser.post(f"/runs/{run_id}/notes", data=fields, files=files, follow_redirects=False)


def notes(web: WebSite, run_id: str) -> list[NoteTaken]:
    return [e.payload for e in web.store.events(run_id) if isinstance(e.payload, NoteTaken)]


def test_what_is_entered_at_the_start_is_the_first_record_and_on_every_page(web: WebSite) -> None:
    browser = web.browser("technician")
    form = browser.get("/start", params={"protocol": "bench.yaml"})
    assert form.status_code == 200
    assert 'value="Grace Hopper"' in form.text
    run_id = start(browser)
    root = web.store.first_event(run_id).payload
    assert isinstance(root, RunStarted)
    assert root.about is not None
    assert root.about.model_dump() == {**ENTERED, "text": "Thawed at 07:30.\nSecond try."}
    for address in (f"/runs/{run_id}", f"/audit/runs/{run_id}"):
        page = browser.get(address).text
        assert "Pilot of the &lt;new&gt; lens" in page, address
        for value in ("Spine 7, L1–L5", "Balgrist, room 4", "Grace Hopper and a student", "Thawed at 07:30."):
            assert value in words(page), address
    assert "Spine 7, L1–L5 · Pilot of the <new> lens" in words(browser.get("/").text)
    assert "Spine 7, L1–L5" in browser.get("/start", params={"protocol": "bench.yaml"}).text  # offered again
    assert verify(web.site.data, run_id).ok


def test_the_start_form_shows_the_protocols_hash_and_its_approval(web: WebSite) -> None:
    browser = web.browser("technician")
    shown = words(browser.get("/start", params={"protocol": "bench.yaml"}).text)
    assert "Not used here before: by starting it you approve this content." in shown
    run_id = start(browser)
    root = web.store.first_event(run_id).payload
    assert isinstance(root, RunStarted)
    shown = words(browser.get("/start", params={"protocol": "bench.yaml"}).text)
    assert root.protocol_sha256 in shown
    assert "Approved by grace" in shown
    (web.site.protocols / "bench.yaml").write_text((web.site.protocols / "bench.yaml").read_text() + "\n# other\n")
    changed = browser.get("/start", params={"protocol": "bench.yaml"}).text
    assert "Approve the change and start" in changed
    assert 'name="reason"' in changed
    assert browser.get("/start", params={"protocol": "../rig.yaml"}).status_code == 422
    assert 'action="/runs"' in changed
    assert "Technicians and supervisors start runs" in web.browser("auditor").get("/start?protocol=bench.yaml").text


@pytest.mark.parametrize("specimen", [None, "", "  \n\t ", "\u0007"])
def test_a_run_does_not_begin_without_the_name_of_its_specimen(web: WebSite, specimen: str | None) -> None:
    browser = web.browser("technician")
    fields = {} if specimen is None else {"specimen": specimen}
    answer = browser.send_form("/runs", protocol="bench.yaml", purpose="pilot", **fields)
    assert answer.status_code == 422
    assert "The specimen is not named" in words(answer.text)
    assert "Enter its name or number" in words(answer.text)
    assert web.store.runs() == []
    form = browser.get("/start", params={"protocol": "bench.yaml"}).text
    assert re.search(r'name="specimen"[^>]* required', form)


def test_the_command_line_asks_for_the_specimen_too(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(PROTOCOL)
    (tmp_path / "rig.yaml").write_text("name: bare\ndevices: {}\n")
    words = ("run", str(tmp_path / "p.yaml"), "--rig", str(tmp_path / "rig.yaml"), "--data", str(tmp_path / "data"))
    refused = typed(*words, "--operator", "A. Name", "--purpose", "pilot")
    assert refused.exit_code == 1
    assert "the specimen is not named" in refused.stderr
    assert not (tmp_path / "data").exists()


def test_only_the_specimen_has_to_be_entered_and_too_much_is_refused(web: WebSite) -> None:
    browser = web.browser("technician")
    answer = browser.send_form("/runs", protocol="bench.yaml", specimen="x" * 201)
    assert answer.status_code >= 400
    assert "at most 200" in answer.text
    assert web.store.runs() == []
    answer = browser.send_form("/runs", protocol="bench.yaml", specimen="S1")
    least = answer.headers["location"].removeprefix("/runs/")
    root = web.store.first_event(least).payload
    assert isinstance(root, RunStarted)
    assert root.about == RunAbout(specimen="S1")
    unattended = web.begin_run().run_id
    assert "<h2>This run</h2>" not in browser.get(f"/runs/{unattended}").text


def test_a_protocol_that_could_not_be_run_to_its_end_does_not_start_and_each_fault_is_a_line(web: WebSite) -> None:
    shipped = (REPOSITORY / "protocols" / "exvivo_spine.yaml").read_text()
    (web.site.protocols / "wrong.yaml").write_text(shipped.replace("      scan: scanning\n", "      scan: scaning\n"))
    answer = web.browser("technician").send_form("/runs", protocol="wrong.yaml")
    assert answer.status_code == 422
    assert "<title>3 things are wrong in this protocol" in answer.text
    assert answer.text.count("there is no step &#39;scaning&#39;; did you mean &#39;scanning&#39;?</li>") == 3
    assert web.store.runs() == []


def test_records_from_before_are_read(web: WebSite) -> None:
    run_id = web.record_run()
    (payload,) = (e.payload.model_dump(mode="json") for e in web.store.events(run_id)[:1])
    del payload["about"]  # like runs recorded before the field existed
    read = PAYLOAD.validate_python(payload)
    assert isinstance(read, RunStarted)
    assert read.about is None


def test_a_note_with_a_photograph_is_evidence_and_shown_everywhere(web: WebSite) -> None:
    browser = web.browser("technician")
    run_id = start(browser)
    picture = jpeg()
    assert note(browser, run_id, "The wire <slipped>\r\nand was\ttightened", picture).status_code == 303
    (taken,) = notes(web, run_id)
    assert (taken.step, taken.attempt, taken.text) == ("fixation", 1, "The wire <slipped>\nand was tightened")
    assert taken.photograph is not None
    assert web.store.artefact_path(taken.photograph.sha256, verify=True).read_bytes() == picture
    assert verify(web.site.data, run_id).ok
    page = browser.get(f"/runs/{run_id}").text
    assert "The wire &lt;slipped&gt;" in page
    assert f"/runs/{run_id}/files/{taken.photograph.sha256}?thumbnail=320" in page
    assert browser.get(f"/runs/{run_id}/files/{taken.photograph.sha256}?thumbnail=320").status_code == 200
    assert "The wire" not in browser.get(f"/runs/{run_id}?step=capture").text
    timeline = browser.get(f"/audit/runs/{run_id}/timeline").text
    assert "note taken" in timeline
    assert "The wire &lt;slipped&gt;" in timeline
    assert f"{taken.photograph.sha256}?thumbnail=160" in timeline
    recorded = read_run(web.site.data, run_id)
    report = render_html(report_content(recorded, verify(web.site.data, run_id)))
    assert "The wire &lt;slipped&gt;" in report
    assert "Spine 7, L1–L5" in report
    bare = render_html(report_content(recorded, verify(web.site.data, run_id), with_pictures=False))
    assert report.count("data:image/jpeg") == bare.count("data:image/jpeg") + 1


def test_the_longest_texts_fit_into_a_printed_report(web: WebSite, tmp_path: Path) -> None:
    browser = web.browser("technician")
    run_id = start(browser, specimen="W" * 200, text="WWWWW MMM " * 400)
    for text in ("W" * 4000, "W MMMMM " * 500, "x\n" * 1999):
        assert note(browser, run_id, text).status_code == 303
    write_pdf(report_content(read_run(web.site.data, run_id), verify(web.site.data, run_id)), tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_a_photograph_that_is_altered_afterwards_is_found(web: WebSite) -> None:
    browser = web.browser("technician")
    run_id = start(browser)
    note(browser, run_id, photograph=jpeg())
    (taken,) = notes(web, run_id)
    assert taken.photograph is not None
    path = web.store.artefact_path(taken.photograph.sha256)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-7] + b"altered")
    assert not verify(web.site.data, run_id).ok


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "neither a JPEG nor a PNG"),
        (jpeg()[:2000], "ends before its picture is complete"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 8 + (10**6).to_bytes(4, "big") * 2 + b"\0" * 99, "1000000 × 1000000"),
        (jpeg() + b"\0" * 16_000_000, "at most 16 MB"),
    ],
)
def test_what_is_no_photograph_or_too_large_is_refused(web: WebSite, content: bytes, why: str) -> None:
    browser = web.browser("technician")
    run_id = start(browser)
    before = len(web.store.events(run_id))
    answer = note(browser, run_id, "look", content)
    assert 400 <= answer.status_code < 500
    assert why in answer.text
    assert len(web.store.events(run_id)) == before


def test_a_request_beyond_all_limits_is_refused_before_it_is_read(web: WebSite) -> None:
    browser = web.browser("technician")
    run_id = start(browser)
    assert note(browser, run_id, photograph=b"\xff\xd8\xff" + b"\0" * 16_300_000).status_code == 413
    large = browser.post(f"/runs/{run_id}/actions", data={"csrf": browser.person.csrf, "reason": "x" * 1_100_000})
    assert large.status_code == 413


def test_who_may_take_notes_and_when(web: WebSite) -> None:
    technician, other = web.browser("technician"), web.browser("supervisor")
    run_id = start(technician)
    assert note(other, run_id, "seen from the other screen").status_code == 303  # needs no control of the run
    assert note(web.browser("auditor"), run_id, "no").status_code == 403
    forged = technician.post(f"/runs/{run_id}/notes", data={"csrf": "forged", "text": "no"}, follow_redirects=False)
    assert forged.status_code == 403
    for text, step in (("", ""), ("   ", ""), ("x" * 4001, ""), ("to nowhere", "nowhere")):
        assert 400 <= note(technician, run_id, text, step=step).status_code < 500
    later = note(technician, run_id, "for later", step="capture")
    assert later.headers["location"] == f"/runs/{run_id}?step=capture"
    assert [n.step for n in notes(web, run_id)] == ["fixation", "capture"]
    web.store.record(run_id, [RunAborted(reason="enough")], actor="runner")
    assert 400 <= note(technician, run_id, "too late").status_code < 500
    assert len(notes(web, run_id)) == 2
    assert "Note…" not in technician.get(f"/runs/{run_id}").text
    assert "seen from the other screen" in technician.get(f"/runs/{run_id}?step=fixation").text


def test_a_note_does_not_make_the_page_out_of_date(web: WebSite) -> None:
    browser = web.browser("technician")
    run_id = start(browser)
    seen = len(web.store.events(run_id))
    note(web.browser("supervisor"), run_id, "meanwhile")
    answer = browser.send_form(
        f"/runs/{run_id}/actions", verb="skip", step="fixation", attempt=1, reason="done", seen_seq=seen
    )
    assert answer.status_code == 303, answer.text


def test_runs_are_found_by_what_people_said_of_them(web: WebSite) -> None:
    browser = web.browser("technician")
    spine = start(browser)
    note(browser, spine, "a drop of Liquid on the marker")
    web.store.record(spine, [RunAborted(reason="enough")], actor="runner")
    knee = start(browser, specimen="Knee 3", purpose="Teaching", text="")
    done = web.record_run()
    find = lambda **wanted: [run.basics.run_id for run in find_runs(web.store, RunSearch(**wanted))]  # noqa: E731
    assert find() == [done, knee, spine]
    assert find(q="spine 7") == [spine]
    assert find(q="KNEE teaching") == [knee]
    assert find(q="liquid") == [spine]
    assert find(q="balgrist") == [knee, spine]
    drawn = [run for run in (knee, spine) if "ada" in run]  # a run's name ends in random letters
    assert find(q="bench ada") == [done, *drawn]
    assert find(q="numpy") == []  # the software's packages are not the subject of a run
    assert find(result="aborted") == [spine]
    assert find(result="completed") == [done]
    assert find(result="open") == [knee]
    day = web.store.runs()[0].created_utc[:10]
    assert find(since=day, until=day) == [done, knee, spine]
    assert find(until="2020-01-01") == []
    page = browser.get("/", params={"q": "liquid", "result": "aborted"})
    assert "1 run matches." in words(page.text)
    assert spine in page.text
    assert done not in page.text
    assert "No finished run matches." in browser.get("/", params={"q": "nowhere"}).text
    listed = web.browser("auditor").get("/audit", params={"q": "knee teaching"}).text
    assert f"/audit/runs/{knee}" in listed
    assert f"/audit/runs/{spine}" not in listed
    assert browser.get("/?q=%ED%A0%80%00+%25+_+'&since=yesterday&result=x").status_code == 200


def test_the_command_line_enters_notes_and_finds_the_same(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(
        "id: one\nversion: '1'\ntitle: One list\nspheres: {radius_mm: 15, registration: 10}\n"
        "camera: {aperture_f: 22, exposure_s: 1/15, iso: 100}\n"
        "steps:\n  - {id: fixation, kind: checklist, title: Fix it, checklist: [it holds]}\n"
    )
    (tmp_path / "rig.yaml").write_text("name: bare\nsimulated: true\ndevices: {}\n")
    data = ("--data", str(tmp_path / "data"))
    ended = typed(
        "run", str(tmp_path / "p.yaml"), "--rig", str(tmp_path / "rig.yaml"), *data, "--auto-confirm", "--no-worker",
        "--operator", "A. Name", "--specimen", "Spine 9", "--purpose", "teaching", "--site", "room 4",
        "--remarks", "thawed",
    )  # fmt: skip
    assert ended.exit_code == 0, ended.stderr
    shown = typed("status", "latest", *data)
    assert "Specimen: Spine 9" in shown.stdout
    found = typed("runs", "--search", "spine thawed", "--result", "completed", "--json", *data)
    (run,) = json.loads(found.stdout)
    assert run["about"] == {
        "specimen": "Spine 9", "purpose": "teaching", "site": "room 4", "operator": "", "text": "thawed",
    }  # fmt: skip
    assert "Spine 9" in typed("runs", *data).stdout
    assert typed("runs", "--search", "knee", *data).stdout.strip() == "No run matches."
    assert typed("runs", "--since", "yesterday", *data).exit_code == 2
    late = typed("note", "too late", "--operator", "A. Name", *data)
    assert late.exit_code == 1
    assert "the run is completed, and its record is closed" in late.stderr


def test_a_note_from_the_command_line(web: WebSite, tmp_path: Path) -> None:
    run_id = web.begin_run().run_id
    (tmp_path / "seen.jpg").write_bytes(jpeg())
    said = password_of("grace")
    grace = ("--operator", "grace", "--password-stdin", "--data", str(web.site.data))
    photograph = ("--photo", str(tmp_path / "seen.jpg"))
    done = typed("note", "a scratch", *photograph, "--step", "capture", *grace, said=said)
    assert done.exit_code == 0, done.stderr
    (taken,) = notes(web, run_id)
    assert (taken.text, taken.step, taken.via) == ("a scratch", "capture", "cli")
    assert taken.photograph is not None
    assert taken.photograph.original_name == "seen.jpg"
    (tmp_path / "seen.jpg").write_bytes(b"text")
    refused = typed("note", *photograph, *grace, said=said)
    assert refused.exit_code == 1
    assert "neither a JPEG nor a PNG" in refused.stderr
    assert verify(web.site.data, run_id).ok


def test_a_bundle_with_notes_verifies_elsewhere_and_an_altered_note_does_not(web: WebSite, tmp_path: Path) -> None:
    browser = web.browser("technician")
    run_id = start(browser)
    note(browser, run_id, "the wire slipped", jpeg())
    web.store.record(run_id, [RunAborted(reason="enough")], actor="runner")
    checkpoint(web.store, run_id)
    made = export_bundle(web.store, run_id, tmp_path / "bundle.zip", actor="ada")
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(tmp_path / "bundle")
    whole = bundle_verifier.Check()
    whole.run(tmp_path / "bundle", None, None)
    assert whole.faults == []
    (taken,) = notes(web, run_id)
    assert taken.photograph is not None
    assert list((tmp_path / "bundle").rglob(f"*{taken.photograph.sha256}*"))
    record = next((tmp_path / "bundle").rglob("events.jsonl"))
    record.write_text(record.read_text().replace("the wire slipped", "the wire held"))
    altered = bundle_verifier.Check()
    altered.run(tmp_path / "bundle", None, None)
    assert altered.faults
