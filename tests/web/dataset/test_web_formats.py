"""The data set in a format, exported on the screen: progress, stop, continue, discard, download, permissions."""

from __future__ import annotations

import hashlib
import html
import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.audit.export_process import export
from service.audit.exports import ExportRequest, WantedExport, keep_request, zip_chunks
from service.core.errors import IntegrityError
from service.core.records.run_events import EvidenceExported
from service.dataset.export_folder import SUMS
from service.dataset.exporter import exporters
from service.store.verification.verify import verify
from tests.support.pages.web import Browser, WebSite, web_site
from tests.support.recorded.reported_run import record_reported_run

pytestmark = pytest.mark.timeout(600)  # each export loads the numerics in a process of its own


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    with web_site(tmp_path_factory.mktemp("web")) as made:
        yield made


@pytest.fixture(scope="module")
def run(web: WebSite) -> str:
    return record_reported_run(web.folder, registered=True)


@pytest.fixture(scope="module")
def supervisor(web: WebSite) -> Browser:
    return web.browser("supervisor")


def page_of(web: WebSite, browser: Browser, run: str) -> str:
    """The page once the formats are listed and no export is running."""
    browser.get(f"/runs/{run}/exports")
    assert web.app.state.formats.known(wait_s=60)
    web.app.state.exports.wait(run, 120)
    page = browser.get(f"/runs/{run}/exports")
    assert page.status_code == 200
    return page.text


def ask(browser: Browser, run: str, form: str, **options: str) -> int:
    return browser.send_form(f"/runs/{run}/exports/formats", form=form, **options).status_code


def fetch(browser: Browser, run: str, name: str) -> dict[str, bytes]:
    """The files of an export's zip file."""
    fetched = browser.get(f"/runs/{run}/exports/{name}")
    assert fetched.status_code == 200
    assert fetched.headers["content-disposition"] == f'attachment; filename="{name}.zip"'
    with zipfile.ZipFile(io.BytesIO(fetched.content)) as archive:
        assert archive.testzip() is None
        return {entry.removeprefix(f"{name}/"): archive.read(entry) for entry in archive.namelist()}


def test_every_registered_format_is_offered(web: WebSite, run: str, supervisor: Browser) -> None:
    page = html.unescape(page_of(web, supervisor, run))
    for name, how in exporters().items():
        assert f'<option value="{name}">{name}: {how.words}</option>' in page


def test_a_format_is_exported_recorded_and_fetched(web: WebSite, run: str, supervisor: Browser) -> None:
    page_of(web, supervisor, run)
    assert ask(supervisor, run, "colmap", anonymous="true") == 303
    page = page_of(web, supervisor, run)
    event = web.store.events(run)[-1]
    assert isinstance(event.payload, EvidenceExported)
    assert (event.payload.what, event.actor) == ("dataset", web.account("supervisor"))
    assert "colmap-anonymous-SIMULATED" in event.payload.file_name
    assert event.payload.file_name in page
    assert event.payload.sha256 in page
    files = fetch(web.browser("auditor"), run, event.payload.file_name)
    assert hashlib.sha256(files[SUMS]).hexdigest() == event.payload.sha256
    lines = [line.partition("  ") for line in files[SUMS].decode().splitlines()]
    listed = {name: sha256 for sha256, _, name in lines}
    assert listed == {name: hashlib.sha256(data).hexdigest() for name, data in files.items() if name != SUMS}
    assert {"images/v001.jpg", "images/v002.jpg", "sparse/0/cameras.txt"} <= listed.keys()
    assert json.loads(files["dataset.json"])["simulated"] is True
    assert verify(web.site.data, run).ok
    assert not web.app.state.exports.unfinished(run)


def test_what_the_form_states_is_in_the_card_and_the_metadata(web: WebSite, run: str, supervisor: Browser) -> None:
    """What is left empty is the protocol's, or said to be missing."""
    page_of(web, supervisor, run)
    stated = {
        "title": 'Spine <7> "b"',
        "licence": "CC-BY-4.0",
        "creators": "Ada L. 0000-0002-1825-0097\r\n\r\n Institute X ",
        "doi": "10.5281/zenodo.1234567",
        "publisher": "ETH Zurich ror.org/05a28rw58",
        "funders": "A fund\r\nAnother fund",
        "version": "2.1.0",
    }
    assert ask(supervisor, run, "plain", **stated) == 303
    page_of(web, supervisor, run)
    event = web.store.events(run)[-1]
    assert isinstance(event.payload, EvidenceExported)
    files = fetch(supervisor, run, event.payload.file_name)
    croissant = json.loads(files["croissant.json"])
    assert croissant["name"] == 'SIMULATED Spine <7> "b"'
    assert (croissant["license"], croissant["version"]) == ("https://spdx.org/licenses/CC-BY-4.0", "2.1.0")
    assert [creator["name"] for creator in croissant["creator"]] == ["Ada L.", "Institute X"]
    assert (croissant["url"], croissant["publisher"]["name"]) == (
        "https://doi.org/10.5281/zenodo.1234567",
        "ETH Zurich",
    )
    assert [funder["name"] for funder in croissant["funder"]] == ["A fund", "Another fund"]
    assert "No ethics statement was given" in croissant["description"]
    card = files["DATACARD.md"].decode()
    assert "Made by**: Ada L. (https://orcid.org/0000-0002-1825-0097), Institute X" in card
    assert "Version 2.1.0" in card


def test_crops_that_do_not_fit_say_so_and_leave_nothing(web: WebSite, run: str, supervisor: Browser) -> None:
    assert ask(supervisor, run, "dtu", crop="9000x9000") == 303
    page = page_of(web, supervisor, run)
    assert "Nothing was exported" in page
    assert "9000 × 9000 px does not fit" in page
    assert "Unfinished" not in page
    assert not list(web.app.state.exports.folder.glob(".*"))


@pytest.mark.parametrize(
    "fields",
    [
        {"form": "nothing"},
        {"form": "../../x"},
        {"form": "colmap", "crop": "1920"},
        {"form": "colmap", "crop": "1x1/../.."},
        {"form": "colmap", "crops": "0"},
        {"form": "colmap", "crops": "17"},
        {"form": ""},
        {"form": "colmap", "version": "1.0"},
        {"form": "colmap", "title": "x" * 1001},
        {"form": "colmap", "creators": "x" * 201},
        {"form": "colmap", "creators": "Ada L. 0000-0002-1825-0098"},
        {"form": "colmap", "licence": "as you like"},
        {"form": "colmap", "doi": "zenodo.1234567"},
        {"form": "colmap", "publisher": "ETH Zurich ror.org/05a28rw59"},
    ],
)
def test_other_formats_and_options_are_refused(
    web: WebSite, run: str, supervisor: Browser, fields: dict[str, str]
) -> None:
    page_of(web, supervisor, run)
    before = web.store.events(run)[-1].seq
    assert supervisor.send_form(f"/runs/{run}/exports/formats", **fields).status_code == 422
    assert web.store.events(run)[-1].seq == before


def test_only_who_may_export_exports_stops_and_discards(web: WebSite, run: str) -> None:
    posts = {
        "formats": {"form": "colmap"},
        "stop": {"since_utc": "2026-11-27T00:00:00Z"},
        "unfinished": {"name": "x", "verb": "discard"},
    }
    for role in ("technician", "auditor", "administrator"):
        browser = web.browser(role)
        for path, fields in posts.items():
            mine = role == "auditor" and path == "stop"  # who makes reports stops what they began; nothing runs here
            assert browser.send_form(f"/runs/{run}/exports/{path}", **fields).status_code == (303 if mine else 403)
        assert "Export in this format" not in browser.get(f"/runs/{run}/exports").text
    supervisor = web.browser("supervisor")
    for path, fields in posts.items():
        assert supervisor.send_form(f"/runs/{run}/exports/{path}", csrf="forged", **fields).status_code == 403
    assert supervisor.send_form(f"/runs/{run}/exports/unfinished", **posts["unfinished"]).status_code == 422


def test_a_run_that_is_not_complete_has_no_data_set(web: WebSite, supervisor: Browser) -> None:
    run = record_reported_run(web.folder, error_mm=0.9, registered=True)
    assert "Only a completed run is exported" in page_of(web, supervisor, run)
    assert ask(supervisor, run, "colmap") == 409


class PowerCutError(Exception):
    """Ends an export in the middle."""


def interrupted(web: WebSite, run: str, name: str, form: str = "colmap") -> Path:
    """An export that was cut off after some files, as after a power cut."""
    folder = web.site.data / "exports"
    folder.mkdir(exist_ok=True)
    keep_request(folder / name, ExportRequest(run, WantedExport(form), "emmy", "2026-11-23T12:00:00.000000Z"))

    def cut(what: str, done: int, _total: int) -> None:
        if what == "writing" and done == 5:
            raise PowerCutError

    with pytest.raises(PowerCutError):
        export(web.site.data, run, "format", folder / name, "emmy", cut)
    return folder / name


def test_an_interrupted_export_goes_on(web: WebSite, run: str, supervisor: Browser) -> None:
    target = interrupted(web, run, f"{run}-exported-cut-SIMULATED")
    kept = {path.name: path.stat().st_mtime_ns for path in target.with_name(f".{target.name}.part").rglob("*.jpg")}
    assert kept
    page = page_of(web, supervisor, run)
    assert "Unfinished: colmap" in page
    assert not target.exists()
    assert target.name not in [file.record.file_name for file in web.app.state.exports.files(web.store.events(run))]
    again = supervisor.send_form(f"/runs/{run}/exports/unfinished", name=target.name, verb="continue")
    assert again.status_code == 303
    page = page_of(web, supervisor, run)
    assert "Unfinished" not in page
    assert {path.name: path.stat().st_mtime_ns for path in target.rglob("*.jpg")}.items() >= kept.items()
    event = web.store.events(run)[-1]
    assert isinstance(event.payload, EvidenceExported)
    assert event.payload.file_name == target.name
    assert not list(target.parent.glob(".*"))


def test_an_interrupted_export_is_discarded(web: WebSite, run: str, supervisor: Browser) -> None:
    target = interrupted(web, run, f"{run}-exported-dropped")
    fields = {"name": target.name, "verb": "discard"}
    assert supervisor.send_form(f"/runs/{run}/exports/unfinished", **fields).status_code == 303
    assert "Unfinished" not in page_of(web, supervisor, run)
    assert not list(target.parent.glob(".*"))
    assert supervisor.send_form(f"/runs/{run}/exports/unfinished", **fields).status_code == 422


def test_hostile_names_are_words_on_the_page(web: WebSite, run: str, supervisor: Browser) -> None:
    target = interrupted(web, run, f"{run}-exported-hostile")
    hostile = '<script>alert("x")</script>'
    keep_request(target, ExportRequest(run, WantedExport(hostile), hostile, "2026-11-23T12:00:00.000000Z"))
    page = page_of(web, supervisor, run)
    assert hostile not in page
    assert hostile in html.unescape(page)
    web.app.state.exports.discard(run, target.name)


def test_a_running_export_is_stopped(web: WebSite, run: str, supervisor: Browser) -> None:
    assert ask(supervisor, run, "hdf5") == 303
    assert ask(supervisor, run, "hdf5") == 409, "one at a time"  # and it does not take away the first one's request
    exports, stop = web.app.state.exports, f"/runs/{run}/exports/stop"
    shown = exports.state(run).since_utc
    another = supervisor.send_form(stop, since_utc="2026-11-23T12:00:00.000000Z")
    assert another.status_code == 409, "the page was about another export, which has ended since"
    while not supervisor.send_form(stop, since_utc=shown).is_error and exports.state(run).pending:
        pass  # until the process is there to be stopped
    page = page_of(web, supervisor, run)
    state = web.app.state.exports.state(run)
    assert state.stopped, state
    assert "was stopped" in page
    for left in web.app.state.exports.unfinished(run):
        web.app.state.exports.discard(run, left.name)
    assert not list(web.app.state.exports.folder.glob(".*"))


def test_an_altered_folder_is_not_sent_as_whole(tmp_path: Path) -> None:
    image = tmp_path / "exported" / "images" / "v001.jpg"
    image.parent.mkdir(parents=True)
    whole = b"a picture" * 1000
    image.write_bytes(whole)
    elsewhere = tmp_path / "elsewhere.jpg"
    elsewhere.write_bytes(whole)
    folder = tmp_path / "exported"
    sums = f"{hashlib.sha256(whole).hexdigest()}  images/v001.jpg\n"
    (folder / SUMS).write_text(sums)
    recorded = hashlib.sha256(sums.encode()).hexdigest()
    assert b"".join(zip_chunks(folder, recorded))[:2] == b"PK"
    image.write_bytes(whole + b"!")
    with pytest.raises(IntegrityError):
        list(zip_chunks(folder, recorded))
    image.unlink()
    image.symlink_to(elsewhere)
    with pytest.raises(IntegrityError):
        list(zip_chunks(folder, recorded))
    image.unlink()
    image.write_bytes(whole)
    (folder / SUMS).write_text(sums + sums)
    with pytest.raises(IntegrityError):
        list(zip_chunks(folder, recorded))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"creators": "Ada L.\nAda L. 0000-0002-1825-0098"}, ("creators", "check digit is wrong")),
        ({"licence": "CC BY 4.0"}, ("licence", "did you mean cc-by-4.0?")),
    ],
)
def test_a_mistyped_identifier_is_named_with_its_field(
    web: WebSite, run: str, supervisor: Browser, fields: dict[str, str], words: tuple[str, ...]
) -> None:
    page_of(web, supervisor, run)
    shown = supervisor.send_form(f"/runs/{run}/exports/formats", form="colmap", **fields).text
    assert all(word in shown for word in words)
