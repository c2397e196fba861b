"""Release and export on the screen: who may, what is blocked and why, and that nothing else can be downloaded."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from service.audit.export.process import export
from service.audit.verify import bundle_verifier
from service.compute.poses.files.pose_files import read_poses_csv
from service.core.errors import StoreError
from service.core.records.events import EvidenceExported, RunReleased
from service.store.store import Store
from service.store.verification.verify import verify
from service.web.audit.exports import MEANINGS
from tests.support.pages.web import Browser, WebSite, password_of, web_site
from tests.support.recorded.registration_record import CAMERA
from tests.support.recorded.reported_run import T_SCAN_CAMERA, record_reported_run
from tests.support.runs.bench_run import PROTOCOL

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
        "meaning": MEANINGS[0],
        "password": password_of(web.account("supervisor")),
        "signed_sha256": web.site.run(run).state.completed_sha256,
    }
    return browser.send_form(f"/runs/{run}/release", **fields | changes).status_code


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
    assert web.site.run(run).state.completed_sha256 in page
    refused = supervisor.send_form(f"/runs/{run}/exports", what="bundle")
    assert refused.status_code == 409
    assert "second person" in refused.text
    assert release(web, supervisor, run, password="wrong") in (401, 403)
    assert release(web, supervisor, run, signed_sha256="0" * 64) == 409
    assert release(web, supervisor, run, meaning="something else") == 422
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
    for role in ("technician", "auditor", "administrator"):
        assert web.browser(role).send_form(f"/runs/{run}/exports", what="bundle").status_code == 403
    assert supervisor.send_form(f"/runs/{run}/exports", what="everything").status_code == 422


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
    target = web.site.data / "orthocapture.sqlite"
    for name in ("../orthocapture.sqlite", "link.zip"):
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
