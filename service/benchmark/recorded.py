"""The benchmark of a recorded run: the job that a person asks for, and the data set that its worker makes."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from service.benchmark.running import HEAT_MAP, OUTPUT, SCORED, write_result, write_truth
from service.computations.benchmark import (
    HEAT_MAPS,
    KIND,
    PRINTED,
    SCORED_MESH,
    Arguments,
    BenchmarkResult,
    Scenario,
)
from service.compute.images.views import SPARSE_VIEWS
from service.core.errors import DataError, IntegrityError
from service.core.gates import refuse_data_set, refuse_export
from service.core.jobs import arguments_name, key_stem
from service.core.protocol import parse_protocol
from service.core.records.events import Event
from service.core.records.run_events import JobFinished, RunStarted
from service.core.run.fold import FoldedRun, fold
from service.core.run.state import LATER
from service.core.words import SIMULATED
from service.dataset.formats.hdf5 import lossless_data_set
from service.dataset.records import DataSet
from service.dataset.registrations import own_registration, registrations
from service.dataset.run_data_set import data_set_of
from service.dataset.summary import ArtefactReader, RunSummary
from service.steps import params_models
from service.store.records import NewJob


@dataclass(frozen=True, slots=True)
class WantedBenchmark:
    """A person's request: a method, the split of the data set, the images' width, the spacing of the samples."""

    method: str
    scenario: Scenario
    width: int
    spacing_m: float


def benchmark_job(run: FoldedRun, wanted: WantedBenchmark) -> NewJob:
    """Return the job that runs a method on a completed run as it is now.

    It has the key of one that waits or is computed, if the same was asked for before; the store then adds none.

    Raises:
        IllegalTransitionError: the run is not complete, or the protocol asks for a release that has not been given.
        DataError: the run has no evaluated registration.
    """
    refusal = refuse_data_set(run.state) or refuse_export(run.protocol, run.state)
    if refusal is not None:
        raise refusal
    own = own_registration(run.protocol, run.state)
    judged = [
        step.id for step in run.protocol.steps if step.gives == "accuracy" and not run.state.steps[step.id].skipped
    ]
    if own is None or not judged:
        raise DataError(
            "the run has no evaluated registration", where=run.run_id, remedy="There is no data set of it"
        )
    registered = registrations(run.protocol, run.state)[own]
    camera = registered.full_camera or registered.camera
    views = len(registered.T_scan_camera)
    width = wanted.width or camera.width
    asked = dataclasses.asdict(wanted)
    arguments = Arguments(
        run=run.run_id,
        upto_seq=run.events[-1].seq,
        head_sha256=run.events[-1].sha256,
        **asked,
        views=min(views, SPARSE_VIEWS) if wanted.scenario == "sparse" else views,
        size_px=(width, round(camera.height * width / camera.width)),
    )
    step = run.state.steps[judged[-1]]
    stem = f"{key_stem(run.state, step.step, KIND.name)}{arguments_name(asked)}/"
    ended = sum(job.idempotency_key.startswith(stem) and job.status != "enqueued" for job in step.jobs.values())
    return NewJob(
        KIND.name, step.step, step.attempt, f"{stem}{ended}", arguments.plain(), priority=LATER, version=KIND.version
    )


def data_set_of_record(events: Sequence[Event], files: ArtefactReader, arguments: Arguments) -> DataSet:
    """Return a run's data set as an export in the format hdf5 would hold it, of the state that the job names.

    Args:
        events: the run's events, which may have become more.
        files: the recorded files; the hash of each that is read is verified.
        arguments: the job's arguments.

    Raises:
        IntegrityError: the record is not the one that the job was enqueued for, or a file is missing or altered.
        DataError: the run does not have what a data set needs.
    """
    meant = events[: arguments.upto_seq]
    if not meant or (meant[-1].seq, meant[-1].sha256) != (arguments.upto_seq, arguments.head_sha256):
        raise IntegrityError(
            "the run's record is not the one that this job was enqueued for",
            where=f"{arguments.run}, event {arguments.upto_seq}",
            remedy="Verify it with `orthocapture audit verify`",
        )
    root = meant[0].payload
    if not isinstance(root, RunStarted):
        raise IntegrityError("the run's first event is not run_started", where=arguments.run)
    verified = _Verified(files)
    content = verified.artefact_path(root.protocol.sha256).read_bytes()
    protocol = parse_protocol(content, params_models(), name=root.protocol.original_name).protocol
    summary = RunSummary(arguments.run, protocol, meant, fold(protocol, meant), verified)
    whole = lossless_data_set(data_set_of(summary))
    return dataclasses.replace(whole, identity=whole.identity.rpartition(" ")[2])  # a hash, without the run's name


def write_answer(run: RunSummary, answered: JobFinished, out: Path) -> BenchmarkResult:
    """Write what a job has answered into the folder of results, as `run_trial` would have; return the result.

    Raises:
        IntegrityError: the answer or a file of it cannot be read.
    """
    result = KIND.read_answer(answered.result)
    folder = out / f"{result.method}-{result.scenario}"
    folder.mkdir(parents=True, exist_ok=True)
    names = {SCORED_MESH: SCORED, HEAT_MAPS: HEAT_MAP, PRINTED: OUTPUT}
    for ref in answered.artefacts:
        if ref.kind in names:
            shutil.copyfile(run.store.artefact_path(ref.sha256, verify=True), folder / names[ref.kind])
    if result.score is not None:
        mark = SIMULATED if result.simulated else ""
        write_truth(out, result.dataset_sha256, run.ground_truth().mesh, mark)
    write_result(folder, result)
    return result


@dataclass(frozen=True, slots=True)
class _Verified:
    """Files of the evidence whose hashes are verified whenever they are read."""

    files: ArtefactReader

    def artefact_path(self, sha256: str, *, verify: bool = True) -> Path:
        return self.files.artefact_path(sha256, verify=True)
