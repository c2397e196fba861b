"""Whether each board image of a calibration step is used, and why not: one answer for every page that shows it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from service.core.records.events import Event, RecordedView
from service.core.run.state import RunState, StepState
from service.jobs.calibration import board_view, calibrate
from service.jobs.calibration.records import Intrinsics
from service.jobs.looks import image_of
from service.steps.notes import board_plans

BOARD_IMAGE = "board_image"
_INSTEAD = "another pose was taken instead"
_SEARCH = re.compile(r" ?\(searched at widths [^)]*\)")  # what the detector once told developers


@dataclass(frozen=True, slots=True)
class BoardUse:
    """Whether one board image is used; `used` is None while that is not known."""

    used: bool | None
    word: str
    why: str = ""

    @property
    def tone(self) -> str:
        """The tone of its word on the pages."""
        return {True: "ok", False: "attention", None: "open"}[self.used]


def board_uses(run: RunState, events: Sequence[Event], step: str) -> Mapping[str, BoardUse]:
    """The uses of a step's valid board images by SHA-256: from their own jobs first, later from the calibration."""
    state = run.steps[step]
    images = {
        payload.artefacts[0].sha256: payload
        for seq in state.captured.values()
        if isinstance(payload := events[seq - 1].payload, RecordedView) and payload.artefacts[0].kind == BOARD_IMAGE
    }
    return {sha256: board_use(state, view) for sha256, view in images.items()}


def calibration_in(state: StepState) -> calibrate.Answer | None:
    """What a step has calibrated; None if its result is not there yet, or of another kind, as of imported images."""
    return calibrate.KIND.read_answer(state.result) if "camera" in state.result else None


def board_use(state: StepState, view: RecordedView) -> BoardUse:
    """Whether one image of a step is used."""
    sha256, name = view.artefacts[0].sha256, view.viewpoint
    looks = [job for job in state.jobs.values() if job.kind == board_view.KIND.name]
    look = next((job for job in looks if image_of(job).sha256 == sha256), None)
    answer = calibration_in(state)
    intrinsics = Intrinsics() if answer is None else answer.details.intrinsics or Intrinsics()
    solved, why = set(intrinsics.images), _reasons(state, answer)
    excluded = {entry.image for entry in intrinsics.excluded}
    if name in solved and name not in excluded:
        return BoardUse(True, "Used", why.get(name, ""))
    found = None
    if look is not None and look.status == "finished":
        found = board_view.KIND.read_answer(look.result)
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


def unused_count(run: RunState, events: Sequence[Event], step: str) -> int:
    """Count the valid board images of a step that are known not to be used."""
    return sum(use.used is False for use in board_uses(run, events, step).values())


def _reasons(state: StepState, answer: calibrate.Answer | None) -> dict[str, str]:
    """Reasons against using an image, by viewpoint."""
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
