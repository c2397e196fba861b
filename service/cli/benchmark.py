"""`orthocapture benchmark`: compare methods of reconstruction and of matching on an exported data set or a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from service.benchmark.methods import Method, method_named, methods, missing
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    error_console,
    print_document,
    print_json,
    print_table,
    progress_bar,
    reporting_errors,
    require_writable,
    require_writable_folder,
    write_whole,
)
from service.cli.ending import stop_requested
from service.cli.options import OperatorOption, PasswordOption, acting_person
from service.computations.benchmark import KIND, BenchmarkResult
from service.core.errors import ComputeError, ConfigurationError, IntegrityError
from service.core.records.run_events import JobFailed, JobFinished
from service.core.units import metres
from service.core.words import counted, time_here
from service.dataset.summary import summarise
from service.machine.executors import computing_as_environment_says
from service.monitor.snapshot import living_workers
from service.run_start import recorded_run
from service.store.data_folder import object_store_of
from service.store.records import Job
from service.store.signatures.signing import checkpoint_here
from service.store.store import Store

if TYPE_CHECKING:
    from service.benchmark.recorded import WantedBenchmark

# --- the benchmark of a recorded run as a job of its site: it is enqueued, waited for, and its answer is written --

Progress = Callable[[str, int, int], None]
_LOOK_S = 1.0
_ARRIVES_S = 300.0  # within which files of an answer must have been uploaded


@dataclass(frozen=True, slots=True)
class AskedBenchmark:
    """A benchmark that stands in the queue of a site; `added` is false if it stood there before."""

    store: Store
    job: Job
    method: Method
    added: bool


def ask_for_benchmark(
    store: Store, run_id: str, method: Method, wanted: WantedBenchmark, *, actor: str
) -> AskedBenchmark:
    """Enqueue the benchmark of a completed run, unless the same waits or is computed already, and sign that.

    Raises:
        IllegalTransitionError: the run is not complete or not released.
        DataError: the run has no evaluated registration.
    """
    from service.benchmark.recorded import benchmark_job  # noqa: PLC0415 - the numerics, which take seconds

    new = benchmark_job(summarise(store, run_id, recorded_run(store, run_id)[0]), wanted)
    added = bool(store.record(run_id, [], actor=actor, jobs=[new]))
    if added and not store.driven(run_id):
        checkpoint_here(store, run_id)
    job = store.job_with_key(run_id, new.idempotency_key)
    assert job is not None  # it was enqueued, now or before
    return AskedBenchmark(store, job, method, added)


def wait_for_benchmark(asked: AskedBenchmark, progress: Progress, *, quiet: bool) -> JobFinished | None:
    """Wait for the answer of a benchmark, and show how it stands; None if Ctrl-C leaves the job to its worker.

    Raises:
        ComputeError: the job has failed, or was cancelled; the message says why.
    """
    shown = ""
    with stop_requested() as leave:
        while (now := _now(asked)).state in ("queued", "running"):
            standing = _standing(asked, now)
            progress(standing, 0, 0)
            if not quiet and standing != shown:
                error_console.print(f"  {standing}")
                shown = standing
            if leave.wait(_LOOK_S):
                return None
    (end,) = (e.payload for e in asked.store.events(now.run_id, (now.ended_seq or 1) - 1)[:1])
    if isinstance(end, JobFailed):
        raise ComputeError(end.message, where=f"job {now.job_id} of run {now.run_id}")
    assert isinstance(end, JobFinished)
    return end


def written_answer(asked: AskedBenchmark, answered: JobFinished, out: Path, progress: Progress) -> BenchmarkResult:
    """Write the answer into the folder of results, and return it.

    Where a site has an object store, its files arrive there after the answer: they are waited for.

    Raises:
        IntegrityError: a file does not arrive, or is altered.
    """
    from service.benchmark.recorded import write_answer  # noqa: PLC0415 - the numerics, which take seconds

    store, run_id = asked.store, asked.job.run_id
    run = summarise(store, run_id, recorded_run(store, run_id)[0])
    arrives = object_store_of(store.database_path.parent) is not None
    until_s = store.clock.monotonic_s() + (_ARRIVES_S if arrives else 0.0)
    while True:
        try:
            return write_answer(run, answered, out)
        except IntegrityError:
            if store.clock.monotonic_s() >= until_s:
                raise
            progress(f"waits for the files of the answer, which {answered.worker} uploads", 0, 0)
            store.clock.sleep(_LOOK_S)


def report_left(asked: AskedBenchmark) -> None:
    """Say where a job is that nobody waits for, and what it waits for."""
    how = "is in the queue" if asked.added else "is in the queue since it was asked for before"
    console.print(f"Job {asked.job.job_id} of run {asked.job.run_id} {how}. The same command waits for its answer")
    console.print(f"  {_standing(asked, _now(asked))}")


def _now(asked: AskedBenchmark) -> Job:
    job = asked.store.job_with_key(asked.job.run_id, asked.job.idempotency_key)
    assert job is not None  # rows are not removed
    return job


def _standing(asked: AskedBenchmark, job: Job) -> str:
    """Describe how a job stands: who computes it, or for which worker it waits."""
    if job.state == "running":
        return f"computed by {job.worker} since {time_here(job.started_utc or '')}"
    store, method = asked.store, asked.method
    data = store.database_path.parent
    here = [sign for sign in living_workers(data, store.clock) if not sign.kinds or KIND.name in sign.kinds]
    hosts = ", ".join(sorted({sign.host for sign in here}))
    listening = (
        f"{counted(len(here), 'worker')} of this folder, on {hosts}, may take it"
        if here
        else "none of this folder listens"
    )
    lacks = missing(method)
    where = f" on a machine with {method.expects} (not this one: {lacks})" if lacks else ""
    start = "" if here and not lacks else f". Start one: `orthocapture worker --kinds {KIND.name} --data {data}`"
    return f"waits for a worker{where}; {listening}{start}"


# --- the commands -------------------------------------------------------------------------------------------------

DEFAULT_OUT = Path("benchmark")


class _Scenario(StrEnum):
    DENSE = "dense"
    SPARSE = "sparse"


def run_command(
    dataset: Annotated[
        str,
        typer.Argument(
            metavar="DATASET|RUN",
            help="Folder written by `orthocapture export --format hdf5`; or a run of --data, by its name, its first "
            "characters, or `latest`: then a worker computes.",
        ),
    ],
    method: Annotated[
        str,
        typer.Option(
            "--method",
            metavar="NAME",
            help="stereo, colmap, pycolmap, openmvs, instant-ngp, neus2, sugar, gsplat, or that of a plug-in.",
        ),
    ],
    scenario: Annotated[_Scenario, typer.Option("--scenario", help="All images, or the split of a few.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the results.")] = DEFAULT_OUT,
    mesh: Annotated[
        Path | None, typer.Option("--mesh", help="Score this mesh of the method, which was made elsewhere.")
    ] = None,
    width: Annotated[
        int, typer.Option(min=0, metavar="PX", help="Width of the images; 0: that of the data set.")
    ] = 0,
    spacing_mm: Annotated[
        float, typer.Option("--spacing-mm", min=0.01, help="Spacing to which both meshes are sampled.")
    ] = 0.1,
    data: DataOption = DEFAULT_DATA,
    no_wait: Annotated[
        bool, typer.Option("--no-wait", help="Of a run: only enqueue the job, and print its number.")
    ] = False,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Reconstruct the specimen with a method, and compare its mesh with the ground truth.

    The method gets images, poses and the extent of the scene in the format that it reads. Its mesh is brought back
    into the frame of the data set, cut to the box of the ground truth, and scored as `evaluate chamfer` does. If the
    method is not installed, the command says what is expected; run it elsewhere and give its mesh with --mesh.

    Of a completed run, the same is computed by a worker of its data folder or site on whose machine the method is
    installed. Its answer is recorded in the run, and written as that of a folder is. The command waits for it; Ctrl-C
    leaves the job in the queue.
    """
    if not _names_folder(dataset):
        with reporting_errors(json):
            from service.benchmark.recorded import WantedBenchmark  # noqa: PLC0415

            how = method_named(method)
            if mesh is not None:
                raise ConfigurationError(
                    "a mesh made elsewhere is scored on an exported data set",
                    where="--mesh",
                    remedy="Export the run with --format hdf5, and name that folder in the place of the run",
                )
            wanted = WantedBenchmark(how.name, scenario.value, width, metres(spacing_mm))
            with Store.open(data, create=False) as store:
                run_id = store.find_run(dataset)
                require_writable_folder(out)
                who = acting_person(store, operator, "export", password_stdin=password_stdin)
                _run_of_site(store, run_id, how, wanted, who.name, None if no_wait else out, json=json)
        return
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        # These load the numerics, which take seconds.
        from service.benchmark.running import Trial, run_trial  # noqa: PLC0415
        from service.compute.surfaces.chamfer import ChamferSettings  # noqa: PLC0415
        from service.dataset.formats.hdf5 import data_set_of_folder  # noqa: PLC0415

        how = method_named(method)
        if no_wait:
            raise ConfigurationError("only the job of a run can be left to a worker", where="--no-wait")
        require_writable_folder(out)
        progress("reading the data set", 0, 0)
        whole = data_set_of_folder(Path(dataset))
        trial = Trial(how, scenario.value, out, mesh, width, ChamferSettings(metres(spacing_mm)))
        with computing_as_environment_says():
            result = run_trial(trial, whole, progress)
    _print_result(result, how, trial.folder, json=json)


def _names_folder(dataset: str) -> bool:
    """Return whether an exported folder is meant: there is one, or it is written as a path."""
    return Path(dataset).is_dir() or len(Path(dataset).parts) > 1


def _run_of_site(
    store: Store, run_id: str, how: Method, wanted: WantedBenchmark, actor: str, out: Path | None, *, json: bool
) -> None:
    """Enqueue a benchmark and, with `out`, wait for its answer, write it there and print it."""

    asked = ask_for_benchmark(store, run_id, how, wanted, actor=actor)
    result = None
    if out is not None:
        with progress_bar(quiet=json) as progress:
            answered = wait_for_benchmark(asked, progress, quiet=json)
            result = None if answered is None else written_answer(asked, answered, out, progress)
    if result is not None and out is not None:
        _print_result(result, how, out / f"{result.method}-{result.scenario}", json=json)
    elif json:
        print_json({"run": run_id, "job": asked.job.job_id})
    else:
        report_left(asked)


def _print_result(result: BenchmarkResult, how: Method, folder: Path, *, json: bool) -> None:
    """Print a result: distances in a sentence, or why there is no mesh."""
    if json:
        print_json(result.model_dump(mode="json"))
    elif result.score is None:
        console.print(f"{how.words}, {result.scenario}: no mesh. {result.failure}")
    else:
        score = result.score
        console.tell(
            f"{how.words}, {result.scenario}, {result.views} images: ",
            (f"Chamfer distance {score.chamfer_mm:.3f} mm", "bold"),
            f" (accuracy {score.accuracy_mm:.3f} mm, "
            f"completeness {score.completeness_mm:.3f} mm; equal surfaces would give {score.floor_mm:.3f} mm)",
        )
        console.print(f"  written: {folder!s}")


def table_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the results.")] = DEFAULT_OUT,
    markdown: Annotated[Path | None, typer.Option("--markdown", help="Write the table to this file too.")] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="Write the meshes with their heat maps, side by side, as PNG.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Print the table of the benchmark, as in the paper: dense and sparse, with times, memory and command lines.

    A method without a result is listed with what it expects and the commands that it would run.
    """
    with reporting_errors(json):
        # These load the numerics, which take seconds.
        from service.benchmark.table import (  # noqa: PLC0415
            figure_png,
            table_markdown,
            table_record,
        )
        from service.computations.benchmark import read_results  # noqa: PLC0415

        results, known = read_results(out), methods()
        text = table_markdown(results, known)
        if markdown is not None:
            require_writable(markdown)
            write_whole(markdown, text)
        if figure is not None:
            require_writable(figure)
            write_whole(figure, figure_png(out, results, known))
        if json:
            print_json(table_record(results, known))
        else:
            print_document(f"{text}\n")


def matching_command(
    dataset: Annotated[Path, typer.Argument(help="Folder that `export --format matching` wrote.")],
    method: Annotated[str, typer.Option(metavar="NAME", help="sift, loftr, lightglue, or that of a plug-in.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the result; several methods may share one.")
    ],
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The weights of a learned method; nothing is downloaded.")
    ] = None,
    pairs_per_class: Annotated[
        int, typer.Option("--pairs-per-class", min=0, help="Pairs of each difficulty at most; 0: all.")
    ] = 50,
    json: JsonOption = False,
) -> None:
    """Score a method of feature matching on image pairs: pose error, precision and epipolar error by difficulty.

    The method is given two images and nothing else. Poses, depth and occlusion only judge its matches. The folder
    gets METHOD.json, pictures of matches, and table.md and curves.png of all methods in it.
    """
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        # These load the numerics, which take seconds.
        from service.benchmark.matching import HEADER, MatchingTask, record, rows, run_matching  # noqa: PLC0415
        from service.compute.matching.methods import matcher  # noqa: PLC0415

        how = matcher(method)
        require_writable_folder(out)
        out.mkdir(exist_ok=True)
        results = run_matching(MatchingTask(dataset, how, weights, pairs_per_class, out), progress)
        if json:
            own = next(result for result in results if result.method == how.name)
            print_json(record(own))
            return
    table = Table(*HEADER)
    for row in rows(results):
        table.add_row(*row)
    print_table(table)
    console.print(f"Written to {out!s}: {how.name}.json, table.md, curves.png")
    if any(result.simulated for result in results):
        console.print("  The data set is simulated.")


benchmark_app = typer.Typer(
    help="Compare methods on an exported data set.", no_args_is_help=True, pretty_exceptions_enable=False
)
benchmark_app.command("run")(run_command)
benchmark_app.command("table")(table_command)
benchmark_app.command("matching")(matching_command)
