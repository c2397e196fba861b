"""A run of a protocol whose step kind a plug-in brings: what runner, page, audit, replay and documents say of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from docs.generate.jobs import jobs_text
from docs.generate.steps import steps_text
from service.audit.background import PartialProgress
from service.audit.provenance import draw, graphs
from service.audit.recorded_run import read_run
from service.audit.replay import replay
from service.core.protocol import parse_protocol
from service.steps import params_models
from service.steps.protocol_check import implausible
from service.store.signatures.signing import checkpoint
from service.web.audit import AuditState
from service.worker.loop import work
from tests.support.pages.web import WebSite, web_site

PROTOCOL = """\
id: weighed
version: "1"
title: Weigh the specimen
spheres: {radius_mm: 15, registration: 10, control: 3}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: scales
    kind: weighing
    title: Weigh it
    gates: [{measure: weight_g, min: 100, unit: g}]
"""


def quiet(_what: str, _done: int, _total: int) -> None:
    """Nobody looks."""


def main(folder: Path) -> None:
    """Print everything as one line of JSON."""
    with web_site(folder) as web:
        bench = web.begin_run(PROTOCOL)
        technician = web.browser("technician")
        web.take_control(bench.run_id, technician)
        web.site.launcher.start(bench.run_id)
        run_page = technician.get(f"/runs/{bench.run_id}").text

        def compute(_seconds: float) -> None:
            work(web.store, until_idle=True, stop=lambda: False, progress=quiet)

        bench.on_wait = compute
        state = bench.run()
        checkpoint(web.store, bench.run_id)
        computed = graphs(web.store)
        graph = computed.get(bench.run_id, wait_s=60)
        assert not isinstance(graph, PartialProgress)
        audit_page = _provenance_page(web, bench.run_id)
        computed.close()
    run = read_run(folder / "data", bench.run_id)
    wrong = parse_protocol(PROTOCOL.replace("weight_g", "weight_mg").encode(), params_models(), name="wrong.yaml")
    said = {
        "status": state.status,
        "measures": dict(state.steps["scales"].measures),
        "run_page": run_page,
        "drawn": [[box.node.kind, box.node.is_job] for box in draw(graph).boxes],
        "audit_page": audit_page,
        "replayed": [[job.kind, job.verdict] for job in replay(run, progress=quiet).jobs],
        "problems": [str(problem) for problem in implausible(wrong)],
        "step_page": steps_text({}),
        "job_page": jobs_text(),
    }
    print(json.dumps(said))  # noqa: T201 - the test reads it


def _provenance_page(web: WebSite, run_id: str) -> str:
    """The auditor's page once its graph is computed, which the first request asks for."""
    auditor = web.browser("auditor")
    address = f"/audit/runs/{run_id}/provenance"
    auditor.get(address)
    state: AuditState = web.app.state.audit
    state.graphs.get(run_id, wait_s=60)
    return auditor.get(address).text


if __name__ == "__main__":
    main(Path(sys.argv[1]))
