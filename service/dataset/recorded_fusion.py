"""What the record of a run says about the fusion that its ground-truth mesh comes from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from service.core.errors import DataError
from service.core.records.events import ArtefactRef
from service.core.run.state import JobState
from service.dataset.summary import RunSummary
from service.jobs.surfaces import fuse

MESH = "ground_truth_mesh"  # kind of the mesh's artefact


@dataclass(frozen=True, slots=True)
class RecordedFusion:
    """What the record says of the fusion from which the data set's mesh comes.

    Attributes:
        step: title of its step.
        answer: of the job.
        measures: of the job, by name.
        spacing_m: of the samples for its Chamfer distance.
        files: its artefacts by kind.
    """

    step: str
    answer: fuse.Answer
    measures: Mapping[str, float]
    spacing_m: float
    files: Mapping[str, ArtefactRef] = field(repr=False)


def recorded_fusion(summary: RunSummary) -> RecordedFusion | None:
    """The fusion whose mesh is the run's ground truth; None if that is the scan.

    Raises:
        DataError: the job that made the mesh is not in the record.
    """
    meshes = summary.artefacts(MESH)
    if not meshes:
        return None
    for step in reversed(summary.protocol.steps):
        for job in summary.state.steps[step.id].jobs.values():
            files = {ref.kind: ref for ref in job.artefacts}
            if job.kind == fuse.KIND.name and files.get(MESH) == meshes[-1]:
                return _read(step.title, job, files)
    raise DataError("no recorded job made the ground truth's mesh", where=summary.run_id)


def _read(step: str, job: JobState, files: Mapping[str, ArtefactRef]) -> RecordedFusion:
    spacing_m = float(job.arguments["spacing_m"])
    return RecordedFusion(step, fuse.KIND.read_answer(job.result), job.measures, spacing_m, files)
