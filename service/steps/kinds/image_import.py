"""Step kind `image_import`: stores photographs that were taken earlier, marked as imported."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from drivers.stated_settings import agrees
from service.core.errors import ConfigurationError, DataError
from service.core.protocol import CameraSection
from service.core.records.base import ArtefactRef, Record
from service.core.records.import_list import ImportedFile, ImportedView, ImportList, PhotographRole
from service.core.records.run_events import RecordedOptics, ViewImported
from service.core.step_params import StepParams
from service.steps.context import StepContext, StepKind, StepOutcome
from service.steps.measures import Count, MeasureRecord
from service.steps.retakes import departing_images, optics_departures
from service.store.records import NewArtefact

_KINDS = {"calibration": "board_image", "image": "image", "control_image": "control_image"}


class Params(StepParams):
    """The photographs of the import that the step takes."""

    photographs: PhotographRole  # part of the import


class Measures(MeasureRecord):
    """The measures of the photographs that were imported."""

    images_imported: Annotated[Count, "photographs of the import"] = None
    raw_files: Annotated[Count, "raw files of the import"] = None
    settings_departures: Annotated[Count, "images with other settings than the protocol's"] = None
    settings_not_stated: Annotated[Count, "images that do not state their settings"] = None
    optics_departures: Annotated[Count, "images whose zoom, focus or lens differs from the calibrated one"] = None


class Result(Record):
    """The role and number of the imported photographs; the images themselves are in the events of the views."""

    photographs: str
    imported: int


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Store every photograph that is not in the evidence yet; after a restart, the others are skipped."""
    listed = context.devices.imported()
    views = () if listed is None else listed.of(params.photographs)
    if listed is None or not views:
        raise ConfigurationError(
            f"there are no photographs to import ({params.photographs.replace('_', ' ')})",
            where=f"step {context.step.id}",
            remedy="Start the run with `orthocapture import` and a folder that contains them",
        )
    there = {view.viewpoint for view in context.evidence.captures(context.step.id)}
    for number, view in enumerate(views):
        context.checkpoint()
        context.progress("photographs", number, len(views))
        if view.name not in there:
            _bring_in(context, params, listed, view)
    context.progress("photographs", len(views), len(views))
    imported = context.evidence.captures(context.step.id)
    departures = optics_departures(context, against_itself=params.photographs == "calibration")
    measures = Measures(
        images_imported=float(len(imported)),
        raw_files=float(sum(len(view.artefacts) - 1 for view in imported)),
        settings_departures=float(sum(not view.verdicts.get("settings", True) for view in imported)),
        settings_not_stated=float(sum("settings" not in view.verdicts for view in imported)),
        optics_departures=None if departures is None else float(departing_images(departures)),
    )
    result = Result(photographs=params.photographs, imported=len(imported))
    return StepOutcome(measures, result=result)


def _bring_in(context: StepContext, params: Params, listed: ImportList, view: ImportedView) -> None:
    """Store one photograph: first its files, then its rows and its event in one transaction."""
    photograph = _put(context, listed, view.photograph, _KINDS[params.photographs])
    refs = (photograph, *(_put(context, listed, raw, "raw") for raw in view.raws))
    settings = stated_settings_agree(view.optics, context.protocol.camera)
    rows = tuple(
        NewArtefact(
            ref=ref,
            device="import",
            step=context.step.id,
            attempt=context.attempt,
            viewpoint=view.name,
            who=context.operator,
            monotonic_s=context.monotonic_s(),
        )
        for ref in refs
    )
    context.evidence.record(
        ViewImported(
            step=context.step.id,
            attempt=context.attempt,
            viewpoint=view.name,
            station="",
            artefacts=refs,
            camera=view.camera,
            verdicts={} if settings is None else {"settings": settings},
            imported_by=context.operator,
            file_name=view.photograph.path,
            modified_utc=view.photograph.modified_utc,
        ),
        artefacts=rows,
    )


def _put(context: StepContext, listed: ImportList, file: ImportedFile, kind: str) -> ArtefactRef:
    path = Path(listed.absolute(file))
    if not path.is_file():
        raise DataError(
            "the photograph is no longer there", where=str(path), remedy="Put it back, then resume the run"
        )
    ref = context.evidence.put_file(path, kind=kind, media_type=file.media_type, original_name=path.name)
    listed.check(str(path), ref.sha256)
    return ref


def stated_settings_agree(stated: RecordedOptics, wanted: CameraSection | None) -> bool | None:
    """Return whether aperture, exposure time and ISO of a photograph are those of the protocol, as in a capture.

    The answer is None if the protocol sets none, or the file gives none of the three.
    """
    if wanted is None:
        return None
    rounded = ((stated.aperture_f, wanted.aperture_f), (stated.exposure_s, wanted.exposure_s))
    agree = [agrees(value, meant) for value, meant in rounded if value]
    agree += [stated.iso == wanted.iso] if stated.iso else []
    return all(agree) if agree else None


KIND = StepKind(
    "image_import",
    Params,
    Measures,
    Result,
    execute,
)
