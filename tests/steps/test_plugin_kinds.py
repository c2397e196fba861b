"""A step kind and a job kind in one file of a plug-in: run, page, audit, replay and documents find them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from tests.support.rig.rig import REPOSITORY

PLUGIN = '''
"""Weigh the specimen: a step kind, and the job kind that computes for it."""

from typing import Annotated

from service.core.step_params import StepParams
from service.core.records.base import Record
from service.computations.kind import JobKind, JobRecord
from service.steps.context import Announcement, JobRequest, StepKind, StepOutcome
from service.steps.measures import Measure, MeasureRecord
from service.computations.job import JobAnswer


class Arguments(JobRecord):
    """Readings of the scales."""

    readings_g: tuple[float, ...]


class Answer(JobRecord):
    """Their mean."""

    mean_g: float


def weigh(context):
    """The mean of the readings, and a file with it."""
    mean_g = sum(context.arguments.readings_g) / len(context.arguments.readings_g)
    ref = context.keep_json({"mean_g": mean_g}, kind="weight", name="weight.json")
    return JobAnswer({"weight_g": mean_g}, (ref,), Answer(mean_g=mean_g))


WEIGH = JobKind(
    name="weigh", arguments=Arguments, answer=Answer, compute="weighing:weigh", words="weight of the specimen"
)


class Params(StepParams):
    """How often it is weighed."""

    times: int = 3


class Measures(MeasureRecord):
    """Of the scales."""

    weight_g: Annotated[float | None, Measure("g", 1, 1e5), "mean of the readings"] = None


class Result(Record):
    """The weight."""

    mean_g: float


def execute(context, params):
    """Weigh the specimen some times."""
    readings = tuple(500.0 + k for k in range(params.times))
    (answer,) = context.evidence.run_jobs(JobRequest.of(WEIGH, Arguments(readings_g=readings)))
    return StepOutcome(
        Measures.read(answer.measures), answer.artefacts, Result(**answer.result), computed_by=(answer.source,)
    )


WEIGHING = StepKind(
    "weighing",
    Params,
    Measures,
    Result,
    execute,
    words=lambda params, _before: Announcement(f"it is weighed {params.times} times"),
    drawing="<svg viewBox='0 0 9 9'><title>scales</title></svg>",
)
'''
ENTRY_POINTS = """\
[orthocapture.steps]
weighing = weighing:WEIGHING

[orthocapture.jobs]
weigh = weighing:WEIGH
"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a program says that has the plug-in on its path, and nothing else of it."""
    folder = tmp_path_factory.mktemp("plugin")
    (folder / "weighing.py").write_text(PLUGIN)
    about = folder / "weighing-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: weighing\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    path = os.pathsep.join([str(folder), str(REPOSITORY)])
    answer = subprocess.run(
        [sys.executable, "-m", "tests.support.processes.plugin_run", str(folder)],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return json.loads(answer.stdout.splitlines()[-1])


pytestmark = pytest.mark.timeout(330)


@pytest.mark.slow
def test_a_run_computes_with_it(seen: dict[str, Any]) -> None:
    assert seen["status"] == "completed"
    assert seen["measures"] == {"weight_g": 501.0}


def test_the_page_has_its_words_and_its_drawing(seen: dict[str, Any]) -> None:
    assert "Confirm: it is weighed 3 times" in seen["run_page"]
    assert "<svg viewBox='0 0 9 9'><title>scales</title></svg>" in seen["run_page"]


@pytest.mark.slow
def test_the_audit_draws_it_and_calls_it_by_its_words(seen: dict[str, Any]) -> None:
    assert ["weigh", True] in seen["drawn"]
    assert ["weight", False] in seen["drawn"]
    assert "weight of the specimen" in seen["audit_page"]


def test_a_replay_computes_it_again(seen: dict[str, Any]) -> None:
    assert seen["replayed"] == [["weigh", "identical"]]


@pytest.mark.slow
def test_the_protocol_check_and_the_documents_know_its_measures(seen: dict[str, Any]) -> None:
    (problem,) = seen["problems"]
    assert "weight_mg" in problem
    assert "## weighing" in seen["step_page"]
    assert "| `weight_g` | Weight g | g | 1 to 100000 | mean of the readings |" in seen["step_page"]
    assert "## weigh\n" in seen["job_page"]
