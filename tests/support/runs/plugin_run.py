"""A run of a protocol whose step kind a plug-in brings: what runner, page, audit, replay and documents say of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from docs.generate.jobs import jobs_text
from docs.generate.steps import steps_text
from service.audit.background.incremental import Progress
from service.audit.provenance.drawing import draw
from service.audit.provenance.graph import graphs
from service.audit.record.run import read_run
from service.audit.replay.replay import replay
from service.core.protocol.models import parse_protocol
from service.jobs.words import term
from service.steps import params_models
from service.steps.protocol_check import implausible
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.web.page.run_words import drawing_of, will_happen
from service.worker.loop import work
from tests.support.runs.bench_run import begin_run

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
    with Store.open(folder / "data") as store:
        bench = begin_run(store, PROTOCOL, folder)
        waiting = bench.state()

        def compute(_seconds: float) -> None:
            work(store, until_idle=True, stop=lambda: False, progress=quiet)

        bench.on_wait = compute
        state = bench.run()
        checkpoint(store, bench.run_id)
        computed = graphs(store)
        graph = computed.get(bench.run_id, wait_s=60)
        computed.close()
        assert not isinstance(graph, Progress)
    run = read_run(folder / "data", bench.run_id)
    step = run.protocol.step("scales")
    wrong = parse_protocol(PROTOCOL.replace("weight_g", "weight_mg").encode(), params_models(), name="wrong.yaml")
    said = {
        "status": state.status,
        "measures": dict(state.steps["scales"].measures),
        "button": will_happen(step, waiting.steps["scales"])[0],
        "drawing": drawing_of(step),
        "drawn": [[box.node.kind, box.node.is_job] for box in draw(graph).boxes],
        "words": term("weigh"),
        "replayed": [[job.kind, job.verdict] for job in replay(run, progress=quiet).jobs],
        "problems": [str(problem) for problem in implausible(wrong)],
        "step_page": steps_text({}),
        "job_page": jobs_text(),
    }
    print(json.dumps(said))  # noqa: T201 - the test reads it


if __name__ == "__main__":
    main(Path(sys.argv[1]))
