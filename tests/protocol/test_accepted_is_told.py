"""Every reader is told of an accepted gate: report, data set, bundle and audit."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from service.audit.bundle import export_bundle
from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import render_html
from service.core.records.run_events import RunCompleted
from service.dataset.exporter import exporter, write_data_set
from service.dataset.run_data_set import data_set_of
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.browsed_run import words
from tests.support.pages.web import WebSite
from tests.support.recorded.reported_run import record_reported_run

ROOT = Path(__file__).parents[2]


@pytest.fixture
def accepted_run(tmp_path: Path) -> tuple[Path, str]:
    """A completed, registered run whose evaluation was accepted at 0.9 mm."""
    return tmp_path, record_reported_run(tmp_path, error_mm=0.9, registered=True, accepted_by="Emmy")


def test_report_data_set_and_bundle_say_it(accepted_run: tuple[Path, str]) -> None:
    folder, run_id = accepted_run
    data = folder / "data"
    run = read_run(data, run_id)
    assert any(isinstance(event.payload, RunCompleted) for event in run.events)
    text = "0.9 mm, allowed ≤ 0.35; accepted by Emmy (supervisor): the pilot does not need it"
    shown = render_html(report_content(run, verify(data, run_id), with_scene=False, with_pictures=False))
    plain = words(shown)
    assert plain.index("gate accepted") < plain.index("redo")  # listed first among the deviations
    assert (
        plain.count("Depends on an accepted gate: Evaluate: Mean radial error of the registration used " + text) >= 2
    )
    write_data_set(data_set_of(run.summary()), exporter("plain"), folder / "dataset")
    described = json.loads((folder / "dataset" / "dataset.json").read_text())
    assert described["accepted_gates"] == [f"Evaluate: Mean radial error of the registration used {text}"]
    with Store.open(data) as store:
        bundle = export_bundle(store, run_id, folder / "bundle.zip", actor="Emmy", hashes_only=True).path
    verifier = ROOT / "service" / "audit" / "bundle_verifier.py"
    done = subprocess.run([sys.executable, verifier, bundle], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "evaluation counts as passed with figures outside their limits, as Emmy (supervisor)" in done.stdout


def test_the_auditor_reads_it_first(web: WebSite) -> None:
    run_id = record_reported_run(web.folder, error_mm=0.9, accepted_by="emmy", person="grace")
    auditor = web.browser("auditor")
    assert auditor.get(f"/audit/runs/{run_id}").status_code == 200
    page = ""
    while "Gate accepted" not in page:  # the digest is computed in the background
        page = auditor.get(f"/audit/runs/{run_id}").text
    first = re.search(r'<table class="table deviations">.*?<tbody>\s*<tr>(.*?)</tr>', page, re.DOTALL)
    assert first is not None
    assert "Gate accepted outside its limits" in first[1]
    signed = auditor.get(f"/audit/runs/{run_id}/signatures").text
    assert "accepted outside its limits: the pilot does not need it" in signed
