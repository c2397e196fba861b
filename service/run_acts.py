"""What people do to a run besides answering it, and their notes: the same rules for pages and command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from service.core.errors import ConfigurationError, DataError, IllegalTransitionError
from service.core.gates import refuse_release, release_meaning
from service.core.picture_files import JPEG_BEGINS, PNG_BEGINS, check_jpeg, check_png, picture_size
from service.core.records.entered import NoteTaken, paragraphs, reason_of
from service.core.records.events import Event
from service.core.records.run_events import ItemTicked, RegionDrawn, RobotSeen, RunReleased
from service.core.run.actions import needs_leave
from service.core.run.state import RunState, connected_arms, lost_arms
from service.core.units import megabytes
from service.dataset.registrations import best_registration
from service.followed_run import RunRecord
from service.store.records import NewArtefact
from service.store.signatures.signing import checkpoint
from service.store.store import Store

_T = TypeVar("_T")
_Point = tuple[float, float, float]
_CORNERS = TypeAdapter(tuple[_Point, ...])
_POINT = TypeAdapter(_Point)
_MOST_CORNERS, _FARTHEST_M = 200, 10.0
DECIDE_AGAIN = "Close the form, read what the page shows now, and decide again; nothing was done"


def require_releasable(state: RunState, actor: str, meaning: str, signed_sha256: str) -> None:
    """Raise IllegalTransitionError if this person may not release the run, or has read another state of it."""
    refusal = refuse_release(state, actor, signed_sha256)
    if refusal is not None:
        raise refusal
    if meaning != release_meaning(state):
        raise IllegalTransitionError(
            "the words of this release are not those for the run as it is now",
            where="meaning",
            remedy="Read the run again and sign it as it is now",
        )


def release_run(
    log: RunRecord, meaning: str, signed_sha256: str, *, actor: str, identified: Literal["claimed", "password"]
) -> Event:
    """Sign, as a second person, that a completed run may be exported. The caller has verified the evidence.

    Raises IllegalTransitionError as `require_releasable` does.
    """
    require_releasable(log.state, actor, meaning, signed_sha256)
    released = RunReleased(meaning=meaning, signed_sha256=signed_sha256, identified=identified)
    (event,) = log.store.record(log.run_id, [released], actor=actor)
    checkpoint(log.store, log.run_id)
    return event


def tick_item(log: RunRecord, step: str, attempt: int, item: str, *, ticked: bool, actor: str) -> None:
    """Mark an item of the checklist, or take the mark back. Raises IllegalTransitionError if it is not asked for."""
    now = log.state.step
    asked = now.phase in ("ready", "recovering") or needs_leave(log.protocol, log.state)
    if log.state.terminal or (step, attempt) != (now.step, now.attempt) or not asked:
        raise out_of_date(log.state)
    if item not in log.protocol.step(step).checklist:
        raise IllegalTransitionError("there is no such item in the checklist", where=step)
    if (item in now.ticked) != ticked:
        marked = ItemTicked(step=step, attempt=attempt, item=item, ticked=ticked)
        log.store.record(log.run_id, [marked], actor=actor)


def cancel_computation(store: Store, run_id: str, job: str, reason: str, *, actor: str) -> Event:
    """End one computation; the step that waits for it asks what to do, as if it had failed.

    Raises IllegalTransitionError if there is no reason, or no such computation that waits or runs.
    """
    return store.cancel_job(run_id, job, actor=actor, reason=reason_of(reason, IllegalTransitionError))


def see_robot(log: RunRecord, device: str, lost_seq: int, *, driven: bool, actor: str) -> None:
    """Record that a person has looked at an arm whose connection was lost. Nothing moves by it.

    `lost_seq` is the event of the loss that was shown to the person, 0 for an arm that was only left alone; `driven`
    says whether a process drives the run. Raises IllegalTransitionError if it stands otherwise with the arm.
    """
    loss = lost_arms(log.state).get(device)
    left_alone = device in connected_arms(log.state) and not driven
    if (loss is None and not left_alone) or lost_seq != (0 if loss is None else loss.seq):
        raise IllegalTransitionError(
            f"the page was out of date: that is not how it stands with {device} any more",
            where=device,
            remedy="Read what the banner says now; nothing was recorded",
        )
    log.store.record(log.run_id, [RobotSeen(device=device, lost_seq=lost_seq)], actor=actor)


def drawing_step(log: RunRecord) -> str:
    """Return the step for whose next fusion a region can be drawn now; "" if there is none.

    It needs the registered scene, in whose frame the region is, and a run that has not ended.
    """
    if log.state.terminal or best_registration(log.protocol, log.state) is None:
        return ""
    return next((step.id for step in log.protocol.steps if step.gives == "ground_truth"), "")


def step_to_draw_for(log: RunRecord) -> str:
    """Return the `drawing_step`. Raises IllegalTransitionError if there is none."""
    step = drawing_step(log)
    if not step:
        raise IllegalTransitionError(
            "no region can be drawn now",
            where="3D view",
            remedy="Draw it after the registration, before the run ends",
        )
    return step


def out_of_date(state: RunState) -> IllegalTransitionError:
    """Return the refusal of an answer to something that the run no longer asks."""
    return IllegalTransitionError(
        "the page was out of date: the run has gone on since it was shown", where=state.current, remedy=DECIDE_AGAIN
    )


def read_region(step: str, source: Literal["ct", "scan"], corners: str, along: str) -> RegionDrawn:
    """Return a region from its texts: corners and direction as JSON, in the frame of the scan, metres.

    Raises ConfigurationError if they are not a polygon on the scene.
    """
    return RegionDrawn(step=step, source=source, corners_m=_read_corners(corners), seen_along=_read_direction(along))


def _read_corners(text: str) -> tuple[_Point, ...]:
    corners = _read(_CORNERS, text)
    near = all(abs(value) <= _FARTHEST_M for corner in corners for value in corner)
    if not 3 <= len(corners) <= _MOST_CORNERS or not near:
        raise _unusable(f"{len(corners)} corners are not a polygon on this scene")
    return corners


def _read_direction(text: str) -> _Point:
    direction = _read(_POINT, text)
    if not 1e-6 < math.hypot(*direction) < 1e6:  # nor is it not a number
        raise _unusable("the polygon has no direction")
    return direction


def _read(kind: TypeAdapter[_T], text: str) -> _T:
    try:
        return kind.validate_json(text)
    except ValidationError as error:
        raise _unusable("the drawn polygon cannot be read") from error


def _unusable(what: str) -> ConfigurationError:
    return ConfigurationError(what, where="3D view", remedy="Draw it again, with at least three corners")


# --- notes on the steps: text, a photograph or both, checked, bounded and recorded in the run's chain -------------

PHOTOGRAPH_BYTES = 16_000_000
NOTE_PHOTOGRAPH = "note_photograph"  # kind of the artefact
_PIXELS = 120_000_000
_REMEDY = "Take the photograph again, as JPEG or PNG"


@dataclass(frozen=True, slots=True)
class NotePhotograph:
    """A photograph as received, with its file name."""

    content: bytes
    name: str = "photograph"


def take_note(
    log: RunRecord,
    text: str,
    photograph: NotePhotograph | None,
    *,
    step: str,
    actor: str,
    via: Literal["web", "cli"],
) -> Event:
    """Record a note on a step (the current one if `step` is "") and return its event.

    Raises:
        IllegalTransitionError: the run has ended (its record is sealed), or there is no such step.
        ConfigurationError: the text is too long.
        DataError: there is neither text nor photograph, or the photograph is too large or not a valid JPEG or PNG.
    """
    state = log.state
    step = step or state.current
    if state.terminal:
        raise IllegalTransitionError(
            f"the run is {state.status}, and its record is closed",
            where=log.run_id,
            remedy="A recorded value can still be corrected, with a reason",
        )
    if step not in state.steps:
        known = ", ".join(log.protocol.step_ids)
        raise IllegalTransitionError(f"there is no step {step!r}", where=log.run_id, remedy=f"It has: {known}")
    said = paragraphs(text, "the note")
    if not said and photograph is None:
        raise DataError("the note is empty", where=step, remedy="Write something, or take a photograph")
    attempt = state.steps[step].attempt
    ref, artefacts = None, ()
    if photograph is not None:
        media_type, suffix = _checked(photograph)
        name = photograph.name.replace("\\", "/").rpartition("/")[2].strip()[-80:] or "photograph"
        name = name if "." in name else f"{name}{suffix}"
        ref = log.store.put_bytes(
            photograph.content, kind=NOTE_PHOTOGRAPH, media_type=media_type, original_name=_plain(name)
        )
        artefacts = (NewArtefact(ref, "note", step, attempt),)
    note = NoteTaken(step=step, attempt=attempt, text=said, photograph=ref, via=via)
    (event,) = log.store.record(log.run_id, [note], actor=actor, artefacts=artefacts)
    return event


def require_size(size_bytes: int, name: str) -> None:
    """Raise DataError if a photograph is too large; called before it is read."""
    if size_bytes > PHOTOGRAPH_BYTES:
        raise DataError(
            f"the photograph has {megabytes(size_bytes):.1f} MB; "
            f"at most {megabytes(PHOTOGRAPH_BYTES):.0f} MB are kept",
            where=_plain(name),
            remedy="Take it with fewer pixels",
        )


def _plain(name: str) -> str:
    return "".join(c if c.isprintable() else "_" for c in name)


def _checked(photograph: NotePhotograph) -> tuple[str, str]:
    """Decode the picture; return its media type and file suffix. Raises DataError."""
    # The decoder takes long to load, and a web process starts without it.
    import cv2  # noqa: PLC0415

    from service.compute.images.photographs import decode  # noqa: PLC0415

    content, name = photograph.content, _plain(photograph.name)
    require_size(len(content), name)
    if content.startswith(JPEG_BEGINS):
        check_jpeg(content, name)
        kind = "image/jpeg", ".jpg"
    elif content.startswith(PNG_BEGINS):
        kind = "image/png", ".png"
        width, height = picture_size(content, name)
        if width * height > _PIXELS:
            raise DataError(f"the picture claims {width} × {height} pixels", where=name, remedy=_REMEDY)
        check_png(content, name)
    else:
        raise DataError("the file is neither a JPEG nor a PNG picture", where=name, remedy=_REMEDY)
    decode(content, cv2.IMREAD_REDUCED_GRAYSCALE_8, name=name, remedy=_REMEDY)
    return kind
