"""Notes on the steps of a run: taking them, with a photograph from the tablet's camera, and showing them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse
from starlette.datastructures import UploadFile

from service.core.errors import DataError
from service.core.records.entered import NoteTaken
from service.core.records.events import ArtefactRef, Event
from service.notes import NotePhotograph, require_size, take_note
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite

router = APIRouter(tags=["notes"])
RunId = Annotated[str, Path(max_length=64)]


@dataclass(frozen=True, slots=True)
class PageNote:
    """A note as pages show it."""

    seq: int
    at_utc: str
    by: str
    step: str
    text: str
    photograph: ArtefactRef | None


def notes_of(events: Iterable[Event], step: str = "") -> tuple[PageNote, ...]:
    """The notes of a run, or of one of its steps, in order."""
    return tuple(
        PageNote(event.seq, event.at_utc, event.actor, note.step, note.text, note.photograph)
        for event in events
        if isinstance(note := event.payload, NoteTaken) and step in ("", note.step)
    )


@router.post("/runs/{run_id}/notes", name="take_note", dependencies=[Depends(requires("operate"))])
async def take(request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Record a note. This does not need control of the run: anybody who works on it may write one.

    The form is read here, after the guard. As parameters of the route it would be read before the guard, and clients
    that are not signed in could fill the disk with photographs.
    """
    async with request.form() as form:
        text, step = (value if isinstance(value := form.get(name), str) else "" for name in ("text", "step"))
        file = form.get("photograph")
        photograph = None
        if isinstance(file, UploadFile) and (file.filename or file.size):
            name = file.filename or "photograph"
            require_size(file.size or 0, name)
            photograph = NotePhotograph(await file.read(), name)
        elif isinstance(file, str) and file:
            raise DataError("the photograph did not arrive", where=run_id, remedy="Load the page again and repeat")
    log = await run_in_threadpool(site.run, run_id)
    event = await run_in_threadpool(
        lambda: take_note(log, text, photograph, step=step, actor=person.account, via="web")
    )
    note = event.payload
    back = f"?step={note.step}" if isinstance(note, NoteTaken) and note.step != log.state.current else ""
    return RedirectResponse(f"/runs/{run_id}{back}", status_code=303)
