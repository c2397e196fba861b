"""Release and export on the screen: who may, what is blocked and why, and that nothing else can be downloaded."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from service.audit import bundle_verifier
from service.audit.export_process import export
from service.cli.main import app
from service.compute.poses.pose_files import read_poses_csv
from service.core.errors import StoreError
from service.core.gates import release_meaning
from service.core.records.run_events import EvidenceExported, OperatorAction, RunReleased, ViewpointCaptured
from service.core.run.actions import record_to_sign
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.people.control import Control
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.browsed_run import words
from tests.support.pages.web import Browser, WebSite, password_of, web_site
from tests.support.recorded.registration_record import CAMERA
from tests.support.recorded.reported_run import T_SCAN_CAMERA, record_reported_run
from tests.support.runs.bench_run import PROTOCOL


class LeftError(Exception):
    """The person has gone."""


def leave(_question: AskOperator, _state: RunState) -> OperatorAction:
    raise LeftError


NEEDS_RELEASE = PROTOCOL.replace("steps:", "release: second_person\nsteps:", 1)


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    with web_site(tmp_path_factory.mktemp("web")) as made:
        yield made


@pytest.fixture(scope="module")
def run(web: WebSite) -> str:
    """A completed run that still needs its release."""
    return web.record_run(NEEDS_RELEASE)


@pytest.fixture(scope="module")
def supervisor(web: WebSite) -> Browser:
    return web.browser("supervisor")


def release(web: WebSite, browser: Browser, run: str, **changes: str) -> int:
    fields = {
        "meaning": release_meaning(web.site.run(run).state),
        "password": password_of(web.account("supervisor")),
        "signed_sha256": web.site.run(run).state.completed_sha256,
    }
    return browser.send_form(f"/runs/{run}/release", **fields | changes).status_code


def verified(web: WebSite, browser: Browser, run: str) -> str:
    """The page of exports, after its button has verified the run."""
    sent = browser.send_form(f"/audit/runs/{run}/verification", back="exports")
    assert sent.headers["location"] == f"/runs/{run}/exports"
    web.app.state.audit.verifications.wait(run, 60)
    return browser.get(f"/runs/{run}/exports").text


def ended(web: WebSite, browser: Browser, run: str, what: str) -> str:
    """The page after an export has ended."""
    assert browser.send_form(f"/runs/{run}/exports", what=what).status_code == 303
    web.app.state.exports.wait(run, 60)
    page = browser.get(f"/runs/{run}/exports")
    assert page.status_code == 200
    return page.text


def test_a_release_takes_a_second_person_with_password_on_the_record_as_it_is(
    web: WebSite, run: str, supervisor: Browser
) -> None:
    page = supervisor.get(f"/runs/{run}/exports").text
    assert "Awaited" in page
    assert "Blocked" in page
    refused = supervisor.send_form(f"/runs/{run}/exports", what="bundle")
    assert refused.status_code == 409
    assert "second person" in refused.text
    assert "Sign and release" not in page
    assert release(web, supervisor, run) == 409  # not verified yet
    page = verified(web, supervisor, run)
    assert "in which nothing deviated from the protocol" in page
    assert web.site.run(run).state.completed_sha256 in page
    assert release(web, supervisor, run, password="wrong") in (401, 403)
    assert release(web, supervisor, run, signed_sha256="0" * 64) == 409
    assert release(web, supervisor, run, meaning="something else") == 409
    for role in ("technician", "auditor", "administrator"):
        assert release(web, web.browser(role), run) == 403
    assert not any(isinstance(event.payload, RunReleased) for event in web.store.events(run))
    assert release(web, supervisor, run) == 303
    event = web.store.events(run)[-1]
    assert isinstance(event.payload, RunReleased)
    assert event.actor == web.account("supervisor")
    assert web.store.checkpoints(run)[-1].seq == event.seq
    assert release(web, supervisor, run) == 409
    page = supervisor.get(f"/runs/{run}/exports").text
    assert "Released" in page
    assert "Sign and release" not in page


def test_a_bundle_is_made_recorded_and_fetched(web: WebSite, run: str, supervisor: Browser, tmp_path: Path) -> None:
    if not web.site.run(run).state.released_by:
        verified(web, supervisor, run)
        release(web, supervisor, run)
    page = ended(web, supervisor, run, "hashes")
    assert "Ready:" in page
    exported = web.store.events(run)[-1]
    assert isinstance(exported.payload, EvidenceExported)
    assert exported.payload.file_name in page
    assert exported.actor == web.account("supervisor")
    auditor = web.browser("auditor")
    fetched = auditor.get(f"/runs/{run}/exports/{exported.payload.file_name}")
    assert fetched.status_code == 200
    assert fetched.headers["content-disposition"].startswith("attachment")
    (tmp_path / "b.zip").write_bytes(fetched.content)
    assert bundle_verifier.main([str(tmp_path / "b.zip")]) == 0
    assert "SIMULATED" in exported.payload.file_name
    for role in ("technician", "administrator"):
        assert web.browser(role).send_form(f"/runs/{run}/exports", what="bundle").status_code == 403
    assert auditor.send_form(f"/runs/{run}/exports", what="dataset").status_code == 403
    assert supervisor.send_form(f"/runs/{run}/exports", what="everything").status_code == 422


def test_a_release_is_of_verified_evidence_and_its_words_name_the_deviations(
    web: WebSite, supervisor: Browser
) -> None:
    run = record_reported_run(web.folder, person="grace", release="second_person")
    page = supervisor.get(f"/runs/{run}/exports").text
    assert "The evidence is verified first" in words(page)
    assert "Sign and release" not in page
    page = verified(web, supervisor, run)
    state = web.site.run(run).state
    assert len(state.deviations) == 2
    for one in state.deviations:
        assert one.text in words(page)
    assert f"with its 2 deviations: viewpoint skipped, {state.deviations[0].text}; redo, " in words(page)
    old = release_meaning(state).replace("2 deviations", "1 deviation")
    assert release(web, supervisor, run, meaning=old) == 409
    assert release(web, supervisor, run) == 303
    event = web.store.events(run)[-1].payload
    assert isinstance(event, RunReleased)
    assert all(one.text in event.meaning for one in state.deviations)
    assert verify(web.site.data, run).ok


def test_an_altered_run_is_not_released(web: WebSite, supervisor: Browser) -> None:
    run = record_reported_run(web.folder, person="grace", release="second_person")
    (image, *_) = [e.payload.artefacts[0] for e in web.store.events(run) if isinstance(e.payload, ViewpointCaptured)]
    photograph = web.store.artefact_path(image.sha256)
    original = photograph.read_bytes()
    photograph.chmod(0o644)
    photograph.write_bytes(original + b"x")
    page = verified(web, supervisor, run)
    assert "Cannot be released" in page
    assert release(web, supervisor, run) == 409
    photograph.write_bytes(original)
    assert "Sign and release" in verified(web, supervisor, run)


@pytest.mark.slow
def test_an_auditor_makes_and_downloads_report_and_bundle(web: WebSite, run: str, supervisor: Browser) -> None:
    auditor = web.browser("auditor")
    unreleased = record_reported_run(web.folder, person="grace", release="second_person")
    page = ended(web, auditor, unreleased, "report")
    assert "Ready:" in page
    (made,) = [e.payload for e in web.store.events(unreleased) if isinstance(e.payload, EvidenceExported)]
    assert b"NOT RELEASED" in auditor.get(f"/runs/{unreleased}/exports/{made.file_name}").content
    assert auditor.send_form(f"/runs/{unreleased}/exports", what="bundle").status_code == 409
    if not web.site.run(run).state.released_by:
        verified(web, supervisor, run)
        release(web, supervisor, run)
    ended(web, auditor, run, "bundle")
    event = web.store.events(run)[-1]
    assert isinstance(event.payload, EvidenceExported)
    assert event.actor == web.account("auditor")
    fetched = auditor.get(f"/runs/{run}/exports/{event.payload.file_name}")
    assert fetched.headers["x-sha256"] == event.payload.sha256


@pytest.mark.slow
def test_exports_made_in_the_terminal_are_on_the_page(web: WebSite, tmp_path: Path) -> None:
    run = record_reported_run(web.folder, person="grace", registered=True)
    data = ("--data", str(web.site.data), "--operator", "emmy", "--password-stdin")
    made = {
        "b-SIMULATED.zip": ("audit", "export", run, str(tmp_path / "b.zip"), "--hashes-only", *data),
        "r.html": ("audit", "report", run, "--html", str(tmp_path / "r.html"), *data),
        "plain-SIMULATED": ("export", run, "--format", "plain", "--out", str(tmp_path / "plain-SIMULATED"), *data),
    }
    for words_of in made.values():
        done = CliRunner().invoke(app, list(words_of), input=password_of("emmy") + "\n")
        assert done.exit_code == 0, done.output
    for role in ("technician", "supervisor", "auditor"):
        page = web.browser(role).get(f"/runs/{run}/exports").text
        assert all(name in page for name in made)
        assert page.count("not kept here: made in the terminal, or taken away") == 3


def test_a_supervisor_signs_without_control_and_is_told_before_that_she_cannot_release_it_then(web: WebSite) -> None:
    bench = web.begin_run(NEEDS_RELEASE)
    bench.script("spraying", "sign", leave)
    with contextlib.suppress(LeftError):
        bench.run()
    web.site.launcher.start(bench.run_id)
    technician, supervisor = web.browser("technician"), web.browser("supervisor")
    web.take_control(bench.run_id, technician)
    page = supervisor.get(f"/runs/{bench.run_id}").text
    told = "You could release this run as the second person. Once you {}, you have taken part in it"
    for act in ("take control", "take over", "sign"):
        assert told.format(act) in words(page), act
    assert "You could release" not in technician.get(f"/runs/{bench.run_id}").text
    assert 'id="dialog-sign"' in page
    assert "decides on the next action" not in page
    state = bench.state()
    fields = {"verb": "sign", "step": "spraying", "attempt": "1", "meaning": "seen", "seen_seq": str(state.seq)}
    fields["signed_sha256"] = record_to_sign(web.site.run(bench.run_id).protocol, state)
    address = f"/runs/{bench.run_id}/actions"
    assert supervisor.send_form(address, **fields, password="wrong").status_code in (401, 403)
    assert supervisor.send_form(address, **fields, password=password_of("emmy")).status_code == 303
    state = bench.state()
    assert (state.step.signed_by, state.controller) == ("emmy", "grace")
    assert Control(web.store).holder(bench.run_id).account == "grace"
    assert "You could release" not in supervisor.get(f"/runs/{bench.run_id}").text  # she has taken part
    refused = supervisor.send_form(address, verb="confirm", step="spraying", attempt="1")
    assert refused.status_code == 409  # anything but a signature still needs control


@pytest.mark.parametrize(
    "name",
    ["orthocapture.sqlite", "..%2Forthocapture.sqlite", "..%2F..%2Frig.yaml", "%2Fetc%2Fpasswd", "x.zip", "%00", "."],
)
def test_nothing_but_recorded_exports_can_be_fetched(web: WebSite, run: str, name: str) -> None:
    exports = web.site.data / "exports"
    exports.mkdir(exist_ok=True)
    (exports / "x.zip").write_text("not recorded")
    fetched = web.browser("auditor").get(f"/runs/{run}/exports/{name}")
    assert fetched.status_code in (404, 422) or fetched.url.path == f"/runs/{run}/exports"
    assert b"SQLite" not in fetched.content
    assert b"not recorded" not in fetched.content


def test_a_recorded_name_that_leads_elsewhere_is_none(web: WebSite) -> None:
    run = web.record_run()
    target = web.site.data / "keys" / "pepper"
    for name in ("../keys/pepper", "link.zip"):
        size = target.stat().st_size
        record = EvidenceExported(
            what="bundle", file_name=name, sha256="0" * 64, size_bytes=size, head_sha256="0" * 64
        )
        web.store.record(run, [record], actor="cli")
    (web.site.data / "exports").mkdir(exist_ok=True)
    (web.site.data / "exports" / "link.zip").symlink_to(target)
    browser = web.browser("auditor")
    assert browser.get(f"/runs/{run}/exports/link.zip").status_code == 422
    page = browser.get(f"/runs/{run}/exports").text
    assert page.count("not kept here") == 2


def test_a_report_leaves_in_both_forms(web: WebSite, supervisor: Browser) -> None:
    run = web.record_run()
    folder = web.site.data / "exports"
    folder.mkdir(exist_ok=True)
    for what, begins in (("report", b"<!doctype html"), ("report_pdf", b"%pdf")):
        made = export(web.site.data, run, what, folder / f"{run}-{what}", "emmy", lambda *_: None)
        last = web.store.events(run)[-1]
        assert isinstance(last.payload, EvidenceExported)
        assert (last.payload.what, last.payload.file_name) == ("report", made.name)
        fetched = supervisor.get(f"/runs/{run}/exports/{made.name}")
        assert fetched.content[:14].lower().startswith(begins)


def test_a_data_set_without_registration_says_why_not(web: WebSite, supervisor: Browser) -> None:
    run = web.record_run()
    page = ended(web, supervisor, run, "dataset")
    assert "Nothing was exported" in page
    assert "no evaluated registration" in page


@pytest.mark.slow
def test_a_data_set_leaves_with_all_that_belongs_to_it(
    web: WebSite, supervisor: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = record_reported_run(web.folder, registered=True)
    page = ended(web, supervisor, run, "dataset")
    assert "Ready:" in page
    event = web.store.events(run)[-1]
    assert isinstance(event.payload, EvidenceExported)
    assert (event.payload.what, event.actor) == ("dataset", web.account("supervisor"))
    assert "SIMULATED" in event.payload.file_name
    fetched = supervisor.get(f"/runs/{run}/exports/{event.payload.file_name}")
    assert hashlib.sha256(fetched.content).hexdigest() == event.payload.sha256
    with zipfile.ZipFile(io.BytesIO(fetched.content)) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name) for name in archive.namelist()}
    assert files.keys() == {
        *("images/v001.jpg", "images/v002.jpg", "camera.json", "poses.csv", "transforms.json"),
        *("mesh.ply", "dataset.json", "splits.json", "views.csv", "DATACARD.md", "croissant.json"),
        *("ro-crate-metadata.json", "SHA256SUMS"),
    }
    described = json.loads(files["dataset.json"])
    assert described["simulated"] is True
    assert (described["run"], described["head_of_chain_sha256"]) == (run, event.payload.head_sha256)
    recorded = {item.ref.sha256 for item in web.store.artefacts(run) if item.attempt == 2}
    for name, sha256 in described["image_sha256"].items():
        assert sha256 in recorded, "of the attempt that counts"
        assert b"SIMULATED" in files[f"images/{name}"]
    assert json.loads(files["camera.json"])["fx"] == CAMERA["fx"], "the camera that was registered"
    (tmp_path / "poses.csv").write_bytes(files["poses.csv"])
    poses = read_poses_csv(tmp_path / "poses.csv")
    assert np.allclose(poses["v002.jpg"], T_SCAN_CAMERA)
    mesh = trimesh.load_mesh(io.BytesIO(files["mesh.ply"]), file_type="ply")
    assert len(mesh.faces) == 4
    assert verify(web.site.data, run).ok
    # An export that cannot be recorded is not made.
    with monkeypatch.context() as patched:
        patched.setattr(Store, "record", _refuse)
        for what in ("dataset", "report", "bundle"):
            with pytest.raises(StoreError, match="no space"):
                export(web.site.data, run, what, tmp_path / f"{what}.zip", "emmy", lambda *_: None)
    assert [path.name for path in tmp_path.iterdir()] == ["poses.csv"]
    # The report within a bundle shows the scene.
    made = export(web.site.data, run, "bundle", tmp_path / "b.zip", "emmy", lambda *_: None)
    assert bundle_verifier.main([str(made)]) == 0
    with zipfile.ZipFile(made) as archive:
        html = archive.read("report.html").decode()
    assert 'id="scene-data"' in html


def _refuse(*_arguments: object, **_more: object) -> None:
    raise StoreError("no space")


@pytest.mark.slow
def test_export_is_blocked_when_the_evidence_fails(web: WebSite, supervisor: Browser) -> None:
    run = web.record_run()
    image = next(item for item in web.store.artefacts(run) if item.ref.kind == "image")
    path = web.store.artefact_path(image.ref.sha256)
    before = path.read_bytes()
    path.chmod(0o644)
    try:
        path.write_bytes(before + b"!")
        page = ended(web, supervisor, run, "bundle")
        assert "Nothing was exported" in page
        assert f"event {image.seq}, artefacts/{image.ref.sha256[:2]}/{image.ref.sha256}" in page
        assert not any(isinstance(event.payload, EvidenceExported) for event in web.store.events(run))
        assert not list((web.site.data / "exports").glob(f"*{run}*"))
    finally:
        path.write_bytes(before)
    assert verify(web.site.data, run).ok
