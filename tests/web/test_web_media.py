"""Pictures and files for the screens: only of this run, small, unaltered, and no hostile file names."""

from __future__ import annotations

import base64
import os
import stat
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.core.errors import DataError
from service.core.picture_files import picture_size
from service.core.records.run_events import FilesKept
from service.monitor.snapshot import frame_path, frames_wanted, write_frame
from service.store.records import NewArtefact
from service.web.images import DrawnOutline, cached, draw_marks, nearest_width, reduced_jpeg, safe_name
from tests.support.pages.browsed_run import BrowsedRun
from tests.support.pages.web import web_site
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import begin_calibrated_run, capture

HOSTILE = '../../etc/pass"wd\r\nSet-Cookie: a=b; .jpg'


@dataclass(frozen=True)
class RunWithImage(BrowsedRun):
    """A run with one image."""

    sha256: str

    @property
    def address(self) -> str:
        return f"/runs/{self.run}"


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Generator[RunWithImage]:
    with web_site(tmp_path_factory.mktemp("media")) as site:
        run = begin_calibrated_run(site)
        sha256 = capture(site, run, "capture", "v1_001", EYE, name=HOSTILE, shade=20)
        yield RunWithImage(site, site.browser("auditor"), run, sha256)


def test_a_file_comes_as_recorded_under_a_harmless_name(shown: RunWithImage) -> None:
    answer = shown.browser.get(f"{shown.address}/files/{shown.sha256}")
    assert answer.content == shown.site.store.artefact_path(shown.sha256).read_bytes()
    assert answer.headers["content-disposition"].startswith("attachment")
    assert "etc" not in answer.headers["content-disposition"]
    assert "set-cookie" not in answer.headers
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "sandbox" in answer.headers["content-security-policy"]
    digest = base64.b64encode(bytes.fromhex(shown.sha256)).decode()
    assert answer.headers["repr-digest"] == f"sha-256=:{digest}:"
    again = {"if-none-match": answer.headers["etag"]}
    assert shown.browser.get(f"{shown.address}/files/{shown.sha256}", headers=again).status_code == 304


def test_a_run_shows_its_own_files_only(shown: RunWithImage) -> None:
    other = shown.site.begin_run().run_id
    assert shown.browser.get(f"/runs/{other}/files/{shown.sha256}").status_code == 404
    assert shown.browser.get(f"/runs/{other}/files/{shown.sha256}?thumbnail=160").status_code == 404


def test_an_altered_file_is_not_handed_out(shown: RunWithImage) -> None:
    sha256 = capture(shown.site, shown.run, "capture", "v1_002", EYE, shade=21)
    path = shown.site.store.artefact_path(sha256)
    path.chmod(stat.S_IWUSR | stat.S_IRUSR)
    path.write_bytes(path.read_bytes()[:-1] + b"\x00")
    for tail in ("", "?thumbnail=320"):
        answer = shown.browser.get(f"{shown.address}/files/{sha256}{tail}")
        assert answer.status_code == 409
        assert "altered" in answer.text


@pytest.mark.parametrize(
    "tail",
    [
        "files/..%2f..%2forthocapture.sqlite",
        "files/" + "A" * 64,
        "files/" + "a" * 63,
        "files/" + "a" * 64,
        "images/..%2f..%2fetc%2fpasswd",
        "images/v1_001%00.jpg",
        "images/v9_999",
        "images/v1_001?width=100000",
        "images/v1_001?seq=1",
        "images/v1_001?attempt=7",
        "images/v1_001?step=nowhere",
        "files/{sha256}?thumbnail=63",
        "files/{sha256}?thumbnail=641",
    ],
)
def test_what_is_not_there_is_refused(shown: RunWithImage, tail: str) -> None:
    answer = shown.browser.get(f"{shown.address}/{tail.format(sha256=shown.sha256)}")
    assert answer.status_code in (404, 422)
    assert "Traceback" not in answer.text


def test_pictures_are_made_small_once(shown: RunWithImage, monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"{shown.address}/files/{shown.sha256}?thumbnail=150"
    first = shown.browser.get(address)
    assert picture_size(first.content) == (160, 107)
    assert "immutable" in first.headers["cache-control"]
    monkeypatch.setattr("service.web.media.reduced_jpeg", lambda *_: pytest.fail("decoded again"))
    assert shown.browser.get(address).content == first.content
    assert not list((shown.site.site.data / "cache").rglob("*.part"))


def test_an_image_is_found_by_its_viewpoint_and_says_when_it_changed(shown: RunWithImage) -> None:
    address = f"{shown.address}/images/v1_001?step=capture&width=640&marked=1"
    answer = shown.browser.get(address)
    assert picture_size(answer.content) == (640, 427)
    tag = {"if-none-match": answer.headers["etag"]}
    assert shown.browser.get(address, headers=tag).status_code == 304
    assert answer.headers["cache-control"] == "private, no-cache"


def test_what_is_no_picture_has_no_thumbnail(shown: RunWithImage) -> None:
    ref = shown.site.store.put_bytes(b"<svg/>", kind="plan", media_type="image/svg+xml", original_name="a.svg")
    kept = FilesKept(step="capture", attempt=1, device="ct", note="n", artefacts=(ref,))
    shown.site.store.record(shown.run, [kept], actor="runner", artefacts=[NewArtefact(ref, "ct", "capture", 1)])
    assert shown.browser.get(f"{shown.address}/files/{ref.sha256}?thumbnail=160").status_code == 415
    assert "attachment" in shown.browser.get(f"{shown.address}/files/{ref.sha256}").headers["content-disposition"]


def test_live_frames_come_only_while_somebody_asks_and_never_old_ones(shown: RunWithImage) -> None:
    data, now_utc_s = shown.site.site.data, shown.site.now_utc_s
    assert frames_wanted(data, shown.run, now_utc_s) is None
    assert shown.browser.get(f"{shown.address}/live-view").status_code == 204
    assert frames_wanted(data, shown.run, now_utc_s) == ""
    write_frame(data, shown.run, b"\xff\xd8frame")
    answer = shown.browser.get(f"{shown.address}/live-view")
    assert (answer.status_code, answer.content) == (200, b"\xff\xd8frame")
    assert answer.headers["cache-control"] == "no-store"
    os.utime(frame_path(data, shown.run), (1.0, 1.0))
    assert shown.browser.get(f"{shown.address}/live-view").status_code == 204
    assert frames_wanted(data, shown.run, now_utc_s - 3600.0) is None, "the clock was set back"
    os.utime(frame_path(data, shown.run), (now_utc_s + 3600.0, now_utc_s + 3600.0))
    assert shown.browser.get(f"{shown.address}/live-view").status_code == 204


def test_plotlys_script_is_public_and_kept_by_browsers(shown: RunWithImage) -> None:
    stranger = shown.site.browser()
    plain = stranger.get("/vendor/plotly.js", headers={"accept-encoding": "identity"})
    packed = stranger.get("/vendor/plotly.js", headers={"accept-encoding": "gzip"})
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.content == plain.content
    assert b"plotly" in plain.content[:200]
    tag = {"if-none-match": plain.headers["etag"]}
    assert stranger.get("/vendor/plotly.js", headers=tag).status_code == 304


# --- pictures by themselves --------------------------------------------------------------------------------------


def test_names_for_downloads_are_harmless() -> None:
    sha256 = "ab" * 32
    assert safe_name("C:\\cards\\DSC 1.JPG", sha256) == "DSC 1.JPG"
    assert safe_name("../..", sha256) == sha256[:12]
    assert safe_name("a\r\nb", sha256) == "a_b"
    assert len(safe_name("x" * 500, sha256)) == 120
    assert nearest_width(65) == 96
    assert nearest_width(9999) == 640


def test_a_large_photograph_is_not_decoded_in_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "large.jpg"
    cv2.imwrite(str(path), np.zeros((2000, 3000, 3), np.uint8))
    decoded: list[tuple[int, ...]] = []
    real = cv2.imdecode

    def watch(data: np.ndarray, how: int) -> np.ndarray:
        image = real(data, how)
        assert image is not None
        decoded.append(image.shape)
        return image

    monkeypatch.setattr(cv2, "imdecode", watch)
    assert picture_size(reduced_jpeg(path, 160)) == (160, 107)
    assert decoded == [(250, 375, 3)]


def test_what_is_no_picture_is_said_to_be_none(tmp_path: Path) -> None:
    for content in (
        b"",
        b"GIF89a",
        b"\xff\xd8\xff\xe0",
        b"\xff\xd8\xff\xc0\x00\x0b\x08\x00\x10\x00\x10\x01\x01\x11\x00",
    ):
        path = tmp_path / "x.jpg"
        path.write_bytes(content)
        with pytest.raises(DataError):
            reduced_jpeg(path, 160)


def test_kinds_of_spheres_are_told_apart_without_colour() -> None:
    angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    outline = 300 + 200 * np.column_stack([np.cos(angles), np.sin(angles)])
    share: dict[str, float] = {}
    for kind in ("registration", "control", "unassigned"):
        picture = np.zeros((600, 640, 3), np.uint8)
        draw_marks(picture, [DrawnOutline(kind, "", outline)], 1.0)
        on = picture[np.rint(outline[:, 1]).astype(int), np.rint(outline[:, 0]).astype(int)].any(axis=1)
        share[kind] = float(on.mean())
    assert share["registration"] > 0.95
    assert 0.45 < share["control"] < 0.85
    assert share["unassigned"] < share["control"] - 0.1


def test_a_broken_making_leaves_nothing_in_the_cache(tmp_path: Path) -> None:
    def fail() -> bytes:
        raise DataError("no picture")

    with pytest.raises(DataError):
        cached(tmp_path, "a", ".jpg", fail)
    assert cached(tmp_path, "a", ".jpg", lambda: b"good").read_bytes() == b"good"
