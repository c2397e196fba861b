"""The cameras of a rig on the capture page: the image of each at a viewpoint with its verdicts, and on the sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from service.run_record import RunRecord
from service.web.capture.view import Verdict, looked_at, settings_verdict
from service.web.record.board_images import BoardUse
from service.web.record.images import Capture, FurtherCapture, further_of, stated_camera

_FEWEST_SPHERES = 4  # that locate a further camera
_MOUNTED = {"fixed": "in the room", "rigid": "beside the first camera"}
_SHEET_SPHERES = "spheres_seen"


@dataclass(frozen=True, slots=True)
class CameraImage:
    """The image of one camera at the viewpoint that is shown.

    Attributes:
        device: name of a further camera in rig.yaml; "" for the first one.
        place: where the camera is, in words.
        sha256: of the photograph.
        width, height: of the photograph as it states them.
        verdicts: of this image.
    """

    device: str
    place: str
    sha256: str
    width: int
    height: int
    verdicts: Sequence[Verdict] = field(repr=False)

    @property
    def bad(self) -> list[Verdict]:
        """The verdicts that did not pass."""
        return [verdict for verdict in self.verdicts if verdict.passed is False]


@dataclass(frozen=True, slots=True)
class SheetImage:
    """An image on the contact sheet: its capture, its photograph, and one word on it with the reason."""

    capture: Capture
    sha256: str
    width: int
    height: int
    word: str
    tone: str
    why: str = ""


def camera_images(
    log: RunRecord, capture: Capture, verdicts: Sequence[Verdict], others: Sequence[Capture]
) -> list[CameraImage]:
    """The images of all cameras at the viewpoint of a capture, the first camera's first.

    Args:
        log: of the run.
        capture: of the viewpoint.
        verdicts: of the first camera's image.
        others: valid captures of the step, whose images each camera's is compared with.
    """
    size = stated_camera(capture.payload)
    images = [CameraImage("", "on the arm", capture.sha256, size.width or 3, size.height or 2, verdicts)]
    beside = {name: [job.live for job in mine] for name, mine in _by_device(log, others).items()}
    for one in further_of(log, capture):
        stated, device = stated_camera(one.exposure), one.exposure.device
        found = looked_at(one.live, beside.get(device, ()), _FEWEST_SPHERES)
        found.append(settings_verdict(stated, one.exposure.verdicts.get("settings")))
        place = _MOUNTED[one.exposure.mounted]
        images.append(CameraImage(device, place, one.sha256, stated.width or 3, stated.height or 2, found))
    return images


def devices_in(log: RunRecord, captures: Sequence[Capture]) -> list[str]:
    """The further cameras that took any of these images."""
    return list(_by_device(log, captures))


def _by_device(log: RunRecord, captures: Sequence[Capture]) -> dict[str, list[FurtherCapture]]:
    found: dict[str, list[FurtherCapture]] = {}
    for capture in captures:
        for one in further_of(log, capture):
            found.setdefault(one.exposure.device, []).append(one)
    return found


def sheet_image(log: RunRecord, capture: Capture, uses: Mapping[str, BoardUse], device: str) -> SheetImage | None:
    """A capture as the contact sheet shows it; None if this further camera did not expose there."""
    if device:
        mine = next((one for one in further_of(log, capture) if one.exposure.device == device), None)
        return None if mine is None else _of_further(capture, mine)
    size = stated_camera(capture.payload)
    word, tone, why = _word(capture, uses.get(capture.sha256))
    return SheetImage(capture, capture.sha256, size.width or 3, size.height or 2, word, tone, why)


def _of_further(capture: Capture, mine: FurtherCapture) -> SheetImage:
    size = stated_camera(mine.exposure)
    if capture.replaced is not None:
        word, tone, why = "Replaced", "quiet", capture.replaced.reason
    elif mine.exposure.verdicts.get("settings") is False:
        word, tone, why = "Departs", "attention", ""
    else:
        word, tone, why = _spheres(mine.live.measures if mine.live else {}, _FEWEST_SPHERES)
    return SheetImage(capture, mine.sha256, size.width or 3, size.height or 2, word, tone, why)


def _word(capture: Capture, use: BoardUse | None) -> tuple[str, str, str]:
    """Word, tone and reason for an image of the first camera."""
    if capture.replaced is not None:
        return "Replaced", "quiet", capture.replaced.reason
    if use is not None:
        return use.word, use.tone, use.why if use.used is False else ""
    if not all(capture.payload.verdicts.values()):
        return "Departs", "attention", ""
    return _spheres(capture.live.measures if capture.live else {}, 3)


def _spheres(measures: Mapping[str, float], fewest: int) -> tuple[str, str, str]:
    if _SHEET_SPHERES not in measures:
        return "Kept", "ok", ""
    seen = measures[_SHEET_SPHERES]
    return f"{seen:.0f} spheres", "ok" if seen >= fewest else "attention", ""
