"""A run's images: valid, replaced or used, what was found in them, and small copies with outlines drawn."""

from __future__ import annotations

import hashlib
import os
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from service.computations.calibration import BOARD_VIEW, CALIBRATE, CalibrateAnswer, Intrinsics
from service.computations.further_cameras import FURTHER_VIEW
from service.computations.live import LIVE_VIEW
from service.computations.records import image_of
from service.core.errors import DataError
from service.core.protocol import Step
from service.core.records.events import Event
from service.core.records.run_events import FurtherExposure, RecordedView, ViewpointCaptured, ViewpointFailed
from service.core.run.state import JobState, RunState, StepState, Superseded
from service.followed_run import RunRecord
from service.rig import RigSection, parse_recorded_rig
from service.steps.notes import board_plans

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from service.dataset.further_cameras import KnownFurtherCamera


def step_to_show(log: RunRecord, steps: Sequence[Step], wanted: str) -> Step | None:
    """Return the step asked for; else the current one, the last one with images, or the first; None without any."""
    by_id = {step.id: step for step in steps}
    if wanted in by_id:
        return by_id[wanted]
    if log.state.current in by_id:
        return by_id[log.state.current]
    begun = [step for step in steps if log.state.steps[step.id].captured]
    return begun[-1] if begun else next(iter(steps), None)


@dataclass(frozen=True, slots=True)
class Capture:
    """One exposure in the record.

    Attributes:
        replaced: the reason and the thing that replaced it, where it is no longer valid.
        live: the job that looked at the image while the capture ran; None where there is none.
    """

    seq: int
    at_utc: str
    payload: RecordedView
    replaced: Superseded | None
    live: JobState | None

    @property
    def sha256(self) -> str:
        """SHA-256 of the photograph."""
        return self.payload.artefacts[0].sha256


@dataclass(frozen=True, slots=True)
class FurtherCapture:
    """The image that a further camera took at a viewpoint; `live` is the job that looked at it."""

    exposure: FurtherExposure
    live: JobState | None

    @property
    def sha256(self) -> str:
        """SHA-256 of the photograph."""
        return self.exposure.artefacts[0].sha256


def further_of(log: RunRecord, capture: Capture) -> list[FurtherCapture]:
    """Return the images of further cameras at the viewpoint of a capture."""
    if not isinstance(capture.payload, ViewpointCaptured) or not capture.payload.further:
        return []
    live = live_jobs(log.state.steps[capture.payload.step])
    return [FurtherCapture(one, live.get(one.artefacts[0].sha256)) for one in capture.payload.further]


def further_cameras_of(log: RunRecord) -> tuple[KnownFurtherCamera, ...]:
    """Return the further cameras of a run, by its valid images."""
    from service.dataset.further_cameras import known_further_cameras  # noqa: PLC0415 - numpy, not needed to start

    seqs = sorted(seq for step in log.state.steps.values() for seq in step.captured.values())
    payloads = (log.events[seq - 1].payload for seq in seqs)
    return known_further_cameras(log.protocol, log.state, (p for p in payloads if isinstance(p, RecordedView)))


def captures_of(log: RunRecord, step: str) -> list[Capture]:
    """Return every exposure of a step in order, including replaced ones."""
    replaced = replaced_events(log)
    live = live_jobs(log.state.steps[step])
    out: list[Capture] = []
    for event in log.events:
        payload = event.payload
        if isinstance(payload, RecordedView) and payload.step == step and event.seq not in log.state.overtaken:
            job = live.get(payload.artefacts[0].sha256)
            out.append(Capture(event.seq, event.at_utc, payload, replaced.get(event.seq), job))
    return out


def valid_capture(log: RunRecord, step: str, viewpoint: str) -> Capture | None:
    """Return the exposure of a viewpoint that counts now."""
    seq = log.state.steps[step].captured.get(viewpoint)
    return None if seq is None else capture_at(log, seq)


def capture_at(log: RunRecord, seq: int) -> Capture | None:
    """Return the exposure that an event records; None where the event is of another kind."""
    if not 1 <= seq <= len(log.events):
        return None
    event = log.events[seq - 1]
    if not isinstance(event.payload, RecordedView) or event.payload.step not in log.state.steps:
        return None
    job = live_jobs(log.state.steps[event.payload.step]).get(event.payload.artefacts[0].sha256)
    return Capture(seq, event.at_utc, event.payload, replaced_events(log).get(seq), job)


def find_capture(
    log: RunRecord, viewpoint: str, *, step: str = "", attempt: int | None = None, seq: int | None = None
) -> Capture | None:
    """Return the exposure of a viewpoint: that of an event, the last of an attempt, or the valid one.

    Without a step the last step that has it.
    """
    if seq is not None:
        found = capture_at(log, seq)
        return found if found is not None and found.payload.viewpoint == viewpoint else None
    steps = [step] if step else [s.id for s in reversed(log.protocol.steps)]
    for name in steps:
        if name not in log.state.steps:
            continue
        if attempt is None:
            found = valid_capture(log, name, viewpoint)
        else:
            mine = [c for c in captures_of(log, name) if c.payload.viewpoint == viewpoint]
            found = next((c for c in reversed(mine) if c.payload.attempt == attempt), None)
        if found is not None:
            return found
    return None


def live_jobs(state: StepState) -> Mapping[str, JobState]:
    """Return the newest job that looked at each photograph of any camera, by SHA-256, finished or not."""
    found: dict[str, JobState] = {}
    for job in sorted(state.jobs.values(), key=lambda j: j.enqueued_seq):
        if job.kind in (LIVE_VIEW.name, FURTHER_VIEW.name):
            found[image_of(job).sha256] = job
    return found


def replaced_events(log: RunRecord) -> Mapping[int, Superseded]:
    """Return what replaced an exposure, by the number of its event."""
    return {seq: past for past in log.state.superseded for seq in past.captured.values()}


def last_failures(log: RunRecord, step: str) -> Mapping[str, str]:
    """Return the message of each viewpoint's last failure in the current attempt."""
    attempt = log.state.steps[step].attempt
    return {
        event.payload.viewpoint: event.payload.message
        for event in log.events
        if isinstance(event.payload, ViewpointFailed)
        and (event.payload.step, event.payload.attempt) == (step, attempt)
    }


BOARD_IMAGE = "board_image"
_INSTEAD = "another pose was taken instead"
_SEARCH = re.compile(r" ?\(searched at widths [^)]*\)")  # what the detector once told developers


@dataclass(frozen=True, slots=True)
class BoardUse:
    """The use of one board image; `used` is None while that is not known."""

    used: bool | None
    word: str
    why: str = ""

    @property
    def tone(self) -> str:
        """The tone of its word on the pages."""
        return {True: "ok", False: "attention", None: "open"}[self.used]


def board_uses(run: RunState, events: Sequence[Event], step: str) -> Mapping[str, BoardUse]:
    """Return the use of a step's valid board images by SHA-256: by their own jobs first, later by the calibration."""
    state = run.steps[step]
    images = {
        payload.artefacts[0].sha256: payload
        for seq in state.captured.values()
        if isinstance(payload := events[seq - 1].payload, RecordedView) and payload.artefacts[0].kind == BOARD_IMAGE
    }
    return {sha256: board_use(state, view) for sha256, view in images.items()}


def calibration_in(state: StepState) -> CalibrateAnswer | None:
    """Return a step's calibration; None if it has no result yet, or one of another kind, as imported images do."""
    return CALIBRATE.read_answer(state.result) if "camera" in state.result else None


def board_use(state: StepState, view: RecordedView) -> BoardUse:
    """Return whether one image of a step is used, and why."""
    sha256, name = view.artefacts[0].sha256, view.viewpoint
    looks = [job for job in state.jobs.values() if job.kind == BOARD_VIEW.name]
    look = next((job for job in looks if image_of(job).sha256 == sha256), None)
    answer = calibration_in(state)
    intrinsics = Intrinsics() if answer is None else answer.details.intrinsics or Intrinsics()
    solved, why = set(intrinsics.images), _reasons(state, answer)
    excluded = {entry.image for entry in intrinsics.excluded}
    if name not in excluded and (name in solved or name in _hand_eye_images(answer)):
        return BoardUse(True, "Used", why.get(name, ""))
    found = None
    if look is not None and look.status == "finished":
        found = BOARD_VIEW.read_answer(look.result)
    unseen = found is not None and not found.seen
    departs = [key for key, passed in view.verdicts.items() if not passed]
    reason = why.get(name) or (_plain(found.reason) if found is not None and not found.seen else "")
    if not reason and departs:
        reason = f"{' and '.join(departs)} not as required"
    if not reason and look is not None and look.status == "failed":
        reason = f"it could not be analysed: {look.message}"
    if reason or unseen:
        return BoardUse(False, "Not used", reason or "no board was found in it")
    if solved:
        return BoardUse(False, "Not used", "the calibration does not use it")
    if look is not None and look.status == "finished":
        return BoardUse(None, "Board found", "it will be used once all images have been taken")
    return BoardUse(None, "Being examined" if look is not None else "Not examined yet")


def _hand_eye_images(answer: CalibrateAnswer | None) -> set[str]:
    """Return the images that a hand-eye calibration used; one that has a step of its own takes images of its own."""
    if answer is None or answer.hand_eye is None:
        return set()
    residuals = answer.hand_eye.best.residuals
    return residuals.mm.keys() | residuals.held_out_mm.keys()


def unused_count(run: RunState, events: Sequence[Event], step: str) -> int:
    """Count the valid board images of a step that are known not to be used."""
    return sum(use.used is False for use in board_uses(run, events, step).values())


def _reasons(state: StepState, answer: CalibrateAnswer | None) -> dict[str, str]:
    """Return reasons against using an image, by viewpoint."""
    why: dict[str, str] = {}
    if answer is not None:
        details, hand_eye = answer.details, answer.hand_eye
        why |= dict.fromkeys(details.views_without_board, "no board was found in it")
        if details.intrinsics is not None:
            why |= {entry.image: entry.reason for entry in details.intrinsics.excluded}
        why |= {} if hand_eye is None else hand_eye.excluded
    for plan in board_plans(state):  # why other poses were planned
        why |= {name: f"{reason} ({_INSTEAD})" for name, reason in plan.instead_of.items()}
    return {name: _plain(reason) for name, reason in why.items()}


def _plain(reason: str) -> str:
    return _SEARCH.sub("", reason).strip()


def recorded_rig_section(log: RunRecord) -> RigSection:
    """Return what the rig file of the run says. Raises ConfigurationError if this version cannot read it."""
    return _section(log.store.artefact_path(log.root.rig.sha256))


def rig_cameras(log: RunRecord) -> tuple[str, ...]:
    """Return the names of its further cameras, in their order; they exist before any of them has taken an image."""
    return tuple(recorded_rig_section(log).cameras)


@lru_cache(maxsize=32)
def _section(path: Path) -> RigSection:
    return parse_recorded_rig(path.read_bytes(), path).section


# --- small copies of large photographs in DIR/cache: made once, replaced as a whole, never evidence ---------------

PICTURES = frozenset({"image/jpeg", "image/png"})
WIDTHS = (64, 96, 160, 320, 640)  # of thumbnails: a few sizes, so that nobody fills the disk with thousands
IMAGE_WIDTHS = (*WIDTHS[3:], 960, 1280, 1920)
#: Drawn on the screen's copy, so that every screen shows the same; version of all that follows.
_VERSION = "1"
_DECODING = threading.BoundedSemaphore(2)  # the capture and its worker need the processor more
_SAFE_NAME = re.compile(r"[^\w.+() -]+")

MarkKind = Literal["registration", "control", "sphere", "unassigned"]
# BGR. Line style and label say the same as the colour.
_COLOURS: dict[MarkKind, tuple[int, int, int]] = {
    "registration": (90, 230, 90),
    "control": (255, 190, 60),
    "sphere": (90, 230, 90),
    "unassigned": (70, 170, 255),
}
_DASHES: dict[MarkKind, tuple[int, int] | None] = {  # drawn, left out: segments of the outline; None: all drawn
    "registration": None,
    "control": (7, 5),
    "sphere": None,
    "unassigned": (2, 4),
}


@dataclass(frozen=True, slots=True)
class DrawnOutline:
    """The outline of one sphere in one image.

    Attributes:
        kind: the kind of thing whose outline it is.
        label: the text that is written into it.
        outline_px: (L, 2) points in pixels of the image as captured.
    """

    kind: MarkKind
    label: str
    outline_px: NDArray[np.float64]


_REMEDY = "Download the recorded file and look at it; it is kept unchanged as evidence"


def nearest_width(width: int, among: Sequence[int] = WIDTHS) -> int:
    """Return the smallest size on offer that is at least `width`, or the largest."""
    return next((known for known in among if known >= width), among[-1])


def cached(folder: Path, key: str, suffix: str, make: Callable[[], bytes]) -> Path:
    """Return the file of a key, made when it is not there. Raises OSError, and what `make` raises."""
    digest = hashlib.sha256(f"{_VERSION} {key}".encode()).hexdigest()
    path = folder / "cache" / digest[:2] / f"{digest}{suffix}"
    if not path.is_file():
        content = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}.part")
        temporary.write_bytes(content)
        temporary.replace(path)
    return path


def reduced_jpeg(path: Path, width: int, marks: Sequence[DrawnOutline] = (), *, upright: bool = False) -> bytes:
    """Return a JPEG of this width, or of the picture's own width if that is smaller, with outlines drawn over it.

    With `upright` it is rotated as its orientation tag says, for people; otherwise it is as stored, for measuring.

    A photograph is decoded at an eighth, a quarter or half of its size if that is wide enough.

    Raises:
        DataError: it is not a picture that can be decoded.
    """
    import cv2  # noqa: PLC0415 - a web process starts without it

    from service.compute.images.photographs import decode_reduced  # noqa: PLC0415 - the same

    content = path.read_bytes()
    with _DECODING:
        picture, stored_px = decode_reduced(content, width, path.name, upright=upright)
        if marks:
            draw_marks(picture, marks, picture.shape[1] / stored_px)
        quality = 80 if width <= WIDTHS[-1] else 88
        done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise DataError("the picture cannot be encoded", where=path.name, remedy=_REMEDY)
    return encoded.tobytes()


def draw_marks(picture: NDArray[np.uint8], marks: Sequence[DrawnOutline], scale: float) -> None:
    """Draw outlines into a picture (H, W, 3): solid, dashed or dotted by kind, each with its label in its middle."""
    import cv2  # noqa: PLC0415 - a web process starts without it
    import numpy as np  # noqa: PLC0415

    width = max(1, round(picture.shape[1] / 500))
    for mark in marks:
        colour = _COLOURS[mark.kind]
        curve = np.rint(((mark.outline_px + 0.5) * scale - 0.5) * 16).astype(np.int32)
        for segment in _segments(curve, _DASHES[mark.kind]):
            for tone, extra in (((0, 0, 0), 2), (colour, 0)):
                closed = len(segment) == len(curve)
                cv2.polylines(picture, [segment], closed, tone, width + extra, cv2.LINE_AA, shift=4)
        if mark.label and picture.shape[1] >= WIDTHS[-1]:
            size = picture.shape[1] / 1700
            x, y = np.rint(mark.outline_px.mean(axis=0) * scale).astype(int)
            place = (int(x - 9 * size * len(mark.label)), int(y + 9 * size))
            for tone, thickness in (((0, 0, 0), 3 * width), (colour, width)):
                cv2.putText(picture, mark.label, place, cv2.FONT_HERSHEY_SIMPLEX, size, tone, thickness, cv2.LINE_AA)


def _segments(curve: NDArray[np.int32], dash: tuple[int, int] | None) -> list[NDArray[np.int32]]:
    if dash is None:
        return [curve]
    on, off = dash
    return [curve[k : k + on + 1] for k in range(0, len(curve), on + off)]


def safe_name(name: str, sha256: str) -> str:
    """Return a safe name for a download: no folder, and no characters with a meaning for a shell or a header."""
    last = _SAFE_NAME.sub("_", name.replace("\\", "/").rsplit("/", 1)[-1]).strip(" .")
    return last[-120:].lstrip(" .") or sha256[:12]
