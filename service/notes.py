"""Notes on the steps of a run: text, a photograph or both, checked, bounded and recorded in the run's chain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.core.errors import DataError, IllegalTransitionError
from service.core.picture_files import JPEG_BEGINS, PNG_BEGINS, check_jpeg, check_png, picture_size
from service.core.records.entered import NoteTaken, paragraphs
from service.core.records.events import Event
from service.core.units import megabytes
from service.followed_run import RunRecord
from service.store.records import NewArtefact

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
