"""The report as PDF: its statements, numbered pages with contents, and its tags for screen readers."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_blocks import Report
from service.audit.report_output import render_pdf
from service.store.verification.verify import verify
from tests.support.pages.pdf_text import fonts_of, pages_of, reader_of, root_of, tags_of
from tests.support.recorded.reported_run import record_reported_run

AT = datetime(2026, 11, 21, 11, 30, 7, tzinfo=UTC)


def report_of(folder: Path) -> Report:
    run = read_run(folder / "data", "latest")
    return report_content(run, verify(folder / "data", run.run_id), made_at=AT, with_scene=False)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    folder = tmp_path_factory.mktemp("reported")
    record_reported_run(folder, registered=True)
    return report_of(folder)


@pytest.fixture(scope="module")
def pdf(report: Report) -> bytes:
    return render_pdf(report)


@pytest.fixture
def no_dejavu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide DejaVu, as on a machine where it is not installed."""
    monkeypatch.setattr("service.audit.report_output._FONT_FOLDERS", ())


@pytest.mark.slow
def test_it_says_the_same_on_numbered_pages(report: Report, pdf: bytes) -> None:
    pages = pages_of(pdf)
    for number, page in enumerate(pages, 1):
        assert f"Page {number} of {len(pages)}" in page
        assert f"Run {report.run_id}" in page
        assert f"chain head {report.head_sha256}" in page
    assert "SIMULATED" in pages[0]
    whole = " ".join(pages)
    for text in ("The evidence verifies", "the cable was loose", "reviewed and accepted", "Part 11-style controls"):
        assert text in whole, text


def test_its_contents_lead_to_every_section(report: Report, pdf: bytes) -> None:
    pages = pages_of(pdf)
    contents = pages[0][pages[0].index("Contents") :]
    reader = reader_of(pdf)
    bookmarks = [mark for mark in reader.outline if not isinstance(mark, list)]
    titles = [f"{number} {section.title}" for number, section in enumerate(report.sections, 1)]
    assert [mark["/Title"] for mark in bookmarks][-len(titles) :] == titles
    for title, mark in zip(titles, bookmarks[-len(titles) :], strict=True):
        at = reader.get_destination_page_number(mark)
        assert at is not None
        assert title in contents
        assert title in pages[at]


def test_it_is_tagged_with_its_language_title_and_true_date(report: Report, pdf: bytes) -> None:
    reader = reader_of(pdf)
    root = root_of(pdf)
    assert root["/MarkInfo"]["/Marked"] is not False
    assert root["/Lang"] == "en"
    assert root["/ViewerPreferences"]["/DisplayDocTitle"] is not False
    assert reader.metadata is not None
    assert reader.metadata.title == f"Report of run {report.run_id}: {report.title}"
    assert reader.metadata.creation_date == AT
    assert reader.metadata.modification_date == AT
    assert reader.xmp_metadata is not None
    assert b"<pdfuaid:part>1</pdfuaid:part>" in reader.xmp_metadata.stream.get_data()
    tags = tags_of(pdf)
    kinds = [kind for kind, _ in tags]
    assert kinds.count("H1") >= len(report.sections)
    assert {"Table", "TH", "TD", "TOC", "Figure", "P"} <= set(kinds)
    levels = [int(kind[1:]) for kind in kinds if kind[0] == "H" and kind[1:].isdigit()]
    assert all(b - a <= 1 for a, b in itertools.pairwise([0, *levels])), "no level is left out"
    assert all(alt for kind, alt in tags if kind == "Figure"), "every picture says what it shows"


def test_the_scene_is_drawn(pdf: bytes) -> None:
    (alt,) = [alt for kind, alt in tags_of(pdf) if kind == "Figure" and alt.startswith("Cameras, spheres")]
    assert "2 cameras and 4 spheres" in alt
    page = next(page for page in reader_of(pdf).pages if "registration spheres" in page.extract_text())
    painted = [
        image
        for image in (cv2.imdecode(np.frombuffer(i.data, np.uint8), cv2.IMREAD_COLOR) for i in page.images)
        if image is not None and image.shape[1] > 1000
    ]
    assert len(painted) == 1
    assert float(np.mean(np.any(painted[0] != 255, axis=2))) > 0.001, "there is something on the sheet"


def test_the_same_evidence_gives_the_same_bytes(tmp_path: Path) -> None:
    record_reported_run(tmp_path, registered=True)
    assert render_pdf(report_of(tmp_path)) == render_pdf(report_of(tmp_path))


@pytest.mark.slow
@pytest.mark.usefixtures("no_dejavu")
def test_greek_and_signs_have_glyphs_without_dejavu(report: Report) -> None:
    pdf = render_pdf(report)
    whole = " ".join(pages_of(pdf))
    for sign in ("Λ", "σ", "χ", "≤", "↔", "✓"):
        assert sign in whole, sign
    fonts = fonts_of(pdf)
    assert any("LibertinusSerif" in font for font in fonts)
    assert not any(font.endswith("DejaVuSans") for font in fonts), "else the machine's own DejaVu was found"
    stated = reader_of(pdf).xmp_metadata
    assert stated is not None
    assert b"pdfuaid:part" in stated.stream.get_data(), "the standard allows no sign without a glyph"


def test_a_sign_that_no_font_has_loses_the_standard_and_not_the_report(tmp_path: Path) -> None:
    record_reported_run(tmp_path, person="Ada \U0001f9ff\U000f0000")
    pdf = render_pdf(report_of(tmp_path))
    reader = reader_of(pdf)
    assert "/StructTreeRoot" in root_of(pdf)
    assert reader.xmp_metadata is not None
    assert b"pdfuaid:part" not in reader.xmp_metadata.stream.get_data()
    assert "Started by Ada" in " ".join(reader.pages[0].extract_text().split())


def test_a_hash_is_copied_whole(report: Report, pdf: bytes) -> None:
    facts = dict(report.facts.rows)
    assert str(facts["SHA-256 of the protocol"]) in pages_of(pdf)[0]
    assert "\u200b" not in pages_of(pdf)[0].split("Contents")[0]
