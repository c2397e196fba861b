"""Job `benchmark`: the data set is made from the record, and the method run as `orthocapture benchmark run` does."""

from __future__ import annotations

from service.benchmark.methods import method_named, place_of
from service.benchmark.recorded import data_set_of_record
from service.benchmark.running import HEAT_MAP, OUTPUT, SCORED, Trial, run_trial
from service.computations.benchmark import HEAT_MAPS, MESH, PRINTED, SCORED_MESH, Arguments
from service.computations.job import JobAnswer, JobContext
from service.compute.surfaces.chamfer import ChamferSettings
from service.machine.executors import LocalProcesses, computing_on


def benchmark(context: JobContext[Arguments]) -> JobAnswer:
    """Run the method, and keep its mesh as it wrote it and as it was scored; what it printed, if it made none.

    All of it is computed on this machine: seconds and memory are results, and a cluster would not see the files.
    """
    arguments = context.arguments
    method = method_named(arguments.method)
    context.progress("reading the run", 0, 0)
    whole = data_set_of_record(context.events(arguments.run), context.store, arguments)
    settings = ChamferSettings(arguments.spacing_m)
    trial = Trial(method, arguments.scenario, context.scratch, None, arguments.width, settings, here_alone=True)
    with computing_on(LocalProcesses()):
        result = run_trial(trial, whole, context.progress)
    score, folder = result.score, trial.folder
    if score is None:
        printed = context.keep_file(folder / OUTPUT, kind=PRINTED, media_type="text/plain")
        return JobAnswer(
            {}, (printed,), result.model_copy(update={"failure": result.failure.replace(f"{folder}/", "")})
        )
    scored = (folder / SCORED).rename(folder / f"scored_{SCORED}")
    artefacts = (
        context.keep_file(method.mesh(place_of(method, folder)), kind=MESH, media_type="application/octet-stream"),
        context.keep_file(scored, kind=SCORED_MESH, media_type="model/ply"),
        context.keep_file(folder / HEAT_MAP, kind=HEAT_MAPS, media_type="image/png"),
    )
    measures = {
        "chamfer_mm": score.chamfer_mm,
        "accuracy_mm": score.accuracy_mm,
        "completeness_mm": score.completeness_mm,
    }
    return JobAnswer(measures, artefacts, result)
