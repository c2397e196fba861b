"""Release of a run by a second person, and its exports: bundle, report, data set in any registered format."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form, Path, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, StreamingResponse
from pydantic import BaseModel, Field, ValidationInfo, field_validator

from service.audit.exports import Exports, Formats, WantedExport, What, zip_chunks
from service.core.errors import ConfigurationError, IllegalTransitionError
from service.core.gates import refuse_data_set, refuse_export, refuse_release, release_meaning
from service.core.records.data_set import FIRST_VERSION, LONGEST_NAME, VERSION, DataSetStatement
from service.core.records.run_events import RunReleased
from service.people.credentials import on_screen_of
from service.people.person import NotAllowedError, Person
from service.run_acts import release_run, require_releasable
from service.web.audit import AuditFrame, CurrentAudit, audit_frame
from service.web.rendering import render
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, RunId, singleton

router = APIRouter(tags=["exports"])

_READ = [Depends(requires("read"))]
_REPORT = [Depends(requires("report"))]
_EXPORT = [Depends(requires("export"))]
_REPORTS: tuple[What, ...] = ("report", "report_pdf")  # which say that a run is not released yet
_LISTING_S, _STOPPING_S = 30.0, 5.0  # how long a press of a button may wait for it


CurrentExports = Annotated[Exports, Depends(singleton("exports", lambda site: Exports(site.data, site.store.clock)))]
CurrentFormats = Annotated[Formats, Depends(singleton("formats", lambda site: Formats(site.store.clock)))]


@router.get("/runs/{run_id}/exports", name="exports", dependencies=_READ, response_class=HTMLResponse)
def exports_page(
    request: Request,
    site: CurrentSite,
    audit: CurrentAudit,
    exports: CurrentExports,
    formats: CurrentFormats,
    person: SignedInPerson,
    run_id: RunId,
) -> Response:
    """Show whether the run may be exported, what has been exported, and the forms to export it."""
    log = site.run(run_id)
    refusal = refuse_export(log.protocol, log.state)
    released = next(
        (e for e in log.events if isinstance(e.payload, RunReleased) and e.actor == log.state.released_by), None
    )
    unfit = refuse_release(log.state, person.account, log.state.completed_sha256)
    return render(
        request,
        "audit/exports.html.j2",
        audit=replace(audit_frame(audit, run_id, ""), here=f"/runs/{run_id}/exports"),
        state=log.state,
        needs_release=log.protocol.release == "second_person",
        released=released,
        refusal=refusal,
        incomplete=refuse_data_set(log.state),
        may_release=person.may("release"),
        unfit=unfit,
        meaning=release_meaning(log.state),
        may_report=person.may("report"),
        may_stop=_may_stop(exports, person, run_id),
        may_export=person.may("export"),
        exporting=exports.state(run_id),
        formats=formats.known(),
        stated=log.protocol.data_set,
        first_version=FIRST_VERSION,
        listing=formats.state(),
        unfinished=exports.unfinished(run_id),
        exports_folder=exports.folder,
        files=exports.files(log.events),
        signed_to=max((item.seq for item in site.store.checkpoints(run_id)), default=0),
    )


@router.post("/runs/{run_id}/release", name="release", dependencies=[Depends(requires("release"))])
def release(
    site: CurrentSite,
    audit: CurrentAudit,
    person: SignedInPerson,
    run_id: RunId,
    meaning: Annotated[str, Form(max_length=20_000)],
    password: Annotated[str, Form(max_length=1000)],
    signed_sha256: Annotated[str, Form(max_length=64)],
) -> RedirectResponse:
    """Sign, as a second person, that a completed run may be exported; its evidence has to be verified first."""
    log = site.run(run_id)
    require_releasable(log.state, person.account, meaning, signed_sha256)
    _require_verified(audit_frame(audit, run_id, ""))
    site.people.check_password(person.account, password, on_screen_of(person))
    release_run(log, meaning, signed_sha256, actor=person.account, identified="password")
    return _back(run_id)


def _require_verified(frame: AuditFrame) -> None:
    """Raise IllegalTransitionError unless the evidence, as it is now, was verified without a fault."""
    if frame.verified == "current":
        return
    what = {
        "faults": "the evidence does not verify",
        "partial": "the evidence could not be compared with its anchors in the object store",
        "outdated": "the evidence has not been verified since its last event",
    }.get(frame.verified, "the evidence has not been verified yet")
    remedy = "Read the faults; nothing is released" if frame.verified == "faults" else "Verify it, then release"
    raise IllegalTransitionError(what, where=frame.run.run_id, remedy=remedy)


@router.post("/runs/{run_id}/exports", name="start_export", dependencies=_REPORT)
def start_export(
    site: CurrentSite, exports: CurrentExports, person: SignedInPerson, run_id: RunId, what: Annotated[What, Form()]
) -> RedirectResponse:
    """Begin an export. It first verifies everything, and writes no file if anything differs."""
    log = site.run(run_id)
    if what == "dataset" and not person.may("export"):
        raise NotAllowedError(f"the role {person.role} may not make a data set", where=run_id)
    refusal = None if what in _REPORTS else refuse_export(log.protocol, log.state)
    if refusal is not None:
        raise refusal
    exports.start(run_id, what, person.account)
    return _back(run_id)


_LINES = ("creators", "funders")  # fields with one entry on each line


class FormatForm(BaseModel):
    """A data set in a format, as the page's form gives it."""

    form: str = Field(max_length=200)
    crop: str = Field("", pattern=r"^([1-9][0-9]{0,5}x[1-9][0-9]{0,5})?$")
    crops: int = Field(1, ge=1, le=16)
    anonymous: bool = False
    title: str = Field("", max_length=1000)
    licence: str = Field("", max_length=1000)
    ethics: str = Field("", max_length=1000)
    creators: str = Field("", max_length=4000)  # one a line
    cite: str = Field("", max_length=1000)
    doi: str = Field("", max_length=1000)
    publisher: str = Field("", max_length=1000)
    funders: str = Field("", max_length=4000)  # one a line
    version: str = Field(FIRST_VERSION, pattern=VERSION)
    csrf: str = ""

    @field_validator(*_LINES)
    @classmethod
    def _short_names(cls, text: str) -> str:
        if any(len(name) > LONGEST_NAME for name in _lines(text)):
            raise ValueError(f"a name has at most {LONGEST_NAME} characters; write one name on each line")
        return text

    @field_validator("licence", "doi", "publisher", "creators", "funders")
    @classmethod
    def _identified(cls, text: str, info: ValidationInfo) -> str:
        name = info.field_name or ""
        stated = DataSetStatement.model_validate({name: _lines(text) if name in _LINES else text.strip()})
        for error in stated.problems().values():
            raise ValueError(str(error))
        return text

    def wanted(self) -> WantedExport:
        """Return the export that is asked for. What the fields of the statement leave out is the protocol's."""
        return WantedExport(self.form, self.crop, self.crops, self.anonymous, self._stated(), self.version)

    def _stated(self) -> DataSetStatement:
        return DataSetStatement(
            title=self.title.strip(),
            licence=self.licence.strip(),
            ethics=self.ethics.strip(),
            creators=_lines(self.creators),
            cite=self.cite.strip(),
            doi=self.doi.strip(),
            publisher=self.publisher.strip(),
            funders=_lines(self.funders),
        )


@router.post("/runs/{run_id}/exports/formats", name="start_format_export", dependencies=_EXPORT)
def start_format_export(
    site: CurrentSite,
    exports: CurrentExports,
    formats: CurrentFormats,
    person: SignedInPerson,
    run_id: RunId,
    asked: Annotated[FormatForm, Form()],
) -> RedirectResponse:
    """Begin an export of the data set in one of the registered formats."""
    log = site.run(run_id)
    refusal = refuse_export(log.protocol, log.state) or refuse_data_set(log.state)
    if refusal is not None:
        raise refusal
    if asked.form not in {known.name for known in formats.known(wait_s=_LISTING_S)}:
        raise ConfigurationError("there is no such format", where=asked.form, remedy="Choose one of the list")
    exports.start_format(run_id, asked.wanted(), person.account, simulated=log.state.simulated)
    return _back(run_id)


@router.post("/runs/{run_id}/exports/stop", name="stop_export", dependencies=_REPORT)
def stop_export(
    exports: CurrentExports, person: SignedInPerson, run_id: RunId, since_utc: Annotated[str, Form(max_length=64)]
) -> RedirectResponse:
    """Stop the export that the page showed, by when it began. What a format has written so far stays."""
    running = exports.state(run_id)
    if running is not None and running.pending and running.since_utc != since_utc:
        raise IllegalTransitionError(
            f"another export runs by now, which {running.by} has begun",
            where=run_id,
            remedy="Read what the page shows now and decide again; nothing was done",
        )
    if not _may_stop(exports, person, run_id):
        raise NotAllowedError("somebody else has begun this export", where=run_id)
    if exports.stop(run_id):
        exports.wait(run_id, _STOPPING_S)
    return _back(run_id)


@router.post("/runs/{run_id}/exports/unfinished", name="unfinished_export", dependencies=_EXPORT)
def unfinished_export(
    site: CurrentSite,
    exports: CurrentExports,
    person: SignedInPerson,
    run_id: RunId,
    name: Annotated[str, Form(max_length=200)],
    verb: Annotated[Literal["continue", "discard"], Form()],
) -> RedirectResponse:
    """Go on with an export that was interrupted, or remove what it left."""
    site.run(run_id)
    if verb == "continue":
        exports.go_on(run_id, name, person.account)
    else:
        exports.discard(run_id, name)
    return _back(run_id)


@router.get("/runs/{run_id}/exports/{file_name}", name="exported_file", dependencies=_READ)
def exported_file(
    site: CurrentSite, exports: CurrentExports, run_id: RunId, file_name: Annotated[str, Path(max_length=200)]
) -> Response:
    """Download one of the recorded exports; a folder as a zip file."""
    path, record = exports.path(site.run(run_id).events, file_name)
    # A download, never shown here: a report may hold scripts, and pages of this origin may act on runs.
    headers = {"X-SHA256": record.sha256, "Cache-Control": "private, no-store"}
    if path.is_dir():
        headers["Content-Disposition"] = f'attachment; filename="{path.name}.zip"'
        chunks = zip_chunks(path, record.sha256)
        return StreamingResponse(chunks, media_type="application/octet-stream", headers=headers)
    return FileResponse(path, filename=path.name, media_type="application/octet-stream", headers=headers)


def _may_stop(exports: Exports, person: Person, run_id: str) -> bool:
    """Return whether a person may stop what is running: who may export everything, others what they started."""
    state = exports.state(run_id)
    return person.may("export") or state is None or not state.pending or state.by == person.account


def _lines(text: str) -> tuple[str, ...]:
    """Return the lines that are not empty."""
    return tuple(filter(None, (line.strip() for line in text.splitlines())))


def _back(run_id: str) -> RedirectResponse:
    return RedirectResponse(f"/runs/{run_id}/exports", status_code=303)
