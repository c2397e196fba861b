"""The printable checklist: all manual work of a protocol, from the start page and from a run."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from service.core.protocol import load_protocol
from service.steps import params_models
from tests.support.pages.browsed_run import words as page_words
from tests.support.pages.web import Browser, web_site

PROTOCOLS = Path(__file__).parents[2] / "protocols"


def plain(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


def words(browser: Browser, address: str) -> str:
    answer = browser.get(address)
    assert answer.status_code == 200, answer.text
    return page_words(answer.text).strip()


@pytest.mark.parametrize("name", sorted(path.name for path in PROTOCOLS.glob("*.yaml")))
def test_every_step_item_and_limit_is_on_the_paper(tmp_path: Path, name: str) -> None:
    with web_site(tmp_path) as web:
        shutil.copy(PROTOCOLS / name, web.site.protocols)
        browser = web.browser("technician")
        assert f"/protocols/{name}/checklist" in browser.get("/").text
        page = words(browser, f"/protocols/{name}/checklist")
        loaded = load_protocol(PROTOCOLS / name, params_models())
        assert loaded.sha256 in page
        for number, step in enumerate(loaded.protocol.steps, start=1):
            assert f"{number}. {plain(step.title)}" in page
            assert plain(step.instructions) in page
            for item in step.checklist:
                assert plain(item) in page
        assert page.count("The robot moves.") == sum(step.moves_robot for step in loaded.protocol.steps)
        assert page.count("This cannot be undone.") == sum(step.irreversible for step in loaded.protocol.steps)


@pytest.mark.parametrize(
    ("name", "captures"),
    [
        ("exvivo_spine.yaml", ["Viewpoint capture at station 1", "Control capture at station 2"]),
        ("handheld_spine.yaml", ["Photograph the specimen from all sides"]),
    ],
)
def test_the_warning_names_the_captures_that_cannot_be_done_again(
    tmp_path: Path, name: str, captures: list[str]
) -> None:
    with web_site(tmp_path) as web:
        shutil.copy(PROTOCOLS / name, web.site.protocols)
        page = words(web.browser("technician"), f"/protocols/{name}/checklist")
    warnings = re.findall(r"None of these can be done again: ([^.]*)\.", page)
    assert warnings
    for warning in warnings:
        assert set(captures) <= set(warning.split(", "))
        assert "Photograph the calibration board" not in warning


def test_a_run_has_that_of_its_own_protocol(tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        run_id = web.begin_run().run_id
        (web.site.protocols / "bench.yaml").unlink()
        browser = web.browser("auditor")
        assert f"/runs/{run_id}/checklist" in browser.get(f"/runs/{run_id}").text
        page = words(browser, f"/runs/{run_id}/checklist")
        assert "wires hold" in page
        assert "Limits: Viewpoints captured at least 3" in page
        assert f"Run {run_id}" in page
        assert browser.get("/protocols/bench.yaml/checklist").status_code in (404, 409, 422)
