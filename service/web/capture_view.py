"""Reads what the capture page shows: each viewpoint's state and images, and the drawing of their plan."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

import numpy as np

from service.computations.further_cameras import FURTHER_VIEW
from service.computations.live import LIVE_SUMMARY, LIVE_VIEW, Suggestion
from service.core.gates import limits
from service.core.protocol import Protocol, Step
from service.core.records.run_events import OperatorAction, RecordedOptics, ViewpointCaptured
from service.core.run.actions import redo_moves, refuse
from service.core.run.state import JobState, StepState
from service.core.units import mm, mrad
from service.followed_run import RunRecord
from service.steps.notes import suggested_views
from service.web.images import (
    BoardUse,
    Capture,
    FurtherCapture,
    board_use,
    board_uses,
    calibration_in,
    captures_of,
    further_of,
    last_failures,
)
from service.web.planned_poses import StationPlan, Vector, nominal_T_flange_camera, place, planned_viewpoints

ViewState = Literal["done", "departs", "unused", "next", "open", "again", "failed", "skipped", "left_out"]
WORDS: Mapping[ViewState, str] = {
    "done": "Done",
    "departs": "Taken, departs",
    "unused": "Taken, not used",
    "next": "Next",
    "open": "To do",
    "again": "To be redone",
    "failed": "Failed",
    "skipped": "Skipped",
    "left_out": "Left out by the plan",
}
TONES: Mapping[ViewState, str] = {
    "done": "ok",
    "departs": "attention",
    "unused": "attention",
    "next": "now",
    "open": "open",
    "again": "now",
    "failed": "stop",
    "skipped": "attention",
    "left_out": "attention",
}
# Guides for the eye, not gates: what the protocol demands is in its gates.
_EDGE_PX = 4.0
_EDGE_FACTOR = 1.5  # of the median of the step's images
_CLIPPED = 0.01
FEWEST_SPHERES = 3


@dataclass(frozen=True, slots=True)
class StepViewpoint:
    """One viewpoint of a step."""

    name: str
    station: str
    state: ViewState
    why: str  # reason of a failure, or of being left out
    position_m: Vector | None  # the camera's position in the base frame of its station
    looks: Vector | None  # its optical axis there
    capture: Capture | None  # the valid one
    replaced: int  # captures that no longer count


@dataclass(frozen=True, slots=True)
class Verdict:
    """One judgement of an image: word, figures, and the guide value or limit that it was compared with."""

    name: str
    passed: bool | None  # None: not known
    word: str
    figures: str
    limit: str = ""


@dataclass(frozen=True, slots=True)
class ViewpointRedo:
    """The possibility to redo a viewpoint now, from where the run is, and whether the robot drives there at once."""

    refused: str
    current: str  # step
    attempt: int  # attempt of the current step
    moves: bool
    paused: bool


def capture_steps(protocol: Protocol) -> list[Step]:
    """Return the steps that take images with the robot."""
    return [
        step
        for step in protocol.steps
        if getattr(step.params, "viewpoints", ()) or getattr(step.params, "board_poses", None) is not None
    ]


def views_of(log: RunRecord, step: Step) -> list[StepViewpoint]:
    """Return every viewpoint of a step in the order of capture: planned, suggested, and taken without either."""
    state = log.state.steps[step.id]
    planned = {v.name: v for v in planned_viewpoints(log, step)}
    refused = _refused(state)
    failures = last_failures(log, step.id)
    captures = captures_of(log, step.id)
    replaced_of = Counter(c.payload.viewpoint for c in captures if c.replaced is not None)
    uses = board_uses(log.state, log.events, step.id)
    valid = {c.payload.viewpoint: c for c in captures if state.captured.get(c.payload.viewpoint) == c.seq}
    order = [name for name in _order(state) if name in planned]
    names = list(dict.fromkeys([*order, *planned, *valid, *state.skipped_viewpoints, *state.viewpoint_failures]))
    names.sort(key=lambda name: name in refused)
    out: list[StepViewpoint] = []
    next_found = state.phase not in ("ready", "running", "recovering") or log.state.current != step.id
    for name in names:
        capture = valid.get(name)
        replaced = replaced_of[name]
        now, why = _state(name, state, capture, refused, failures, replaced=replaced > 0)
        use = None if capture is None else uses.get(capture.sha256)
        if use is not None and use.used is False:
            now, why = "unused", use.why
        if now in ("open", "again", "failed") and not next_found:
            next_found = True
            now = "next" if now == "open" else now
        position, looks = _place(log, capture) if capture is not None else (None, None)
        station = "" if capture is None else capture.payload.station
        if name in planned:
            position, looks, station = planned[name].position_m, planned[name].looks, planned[name].station
        out.append(StepViewpoint(name, station, now, why, position, looks, capture, replaced))
    return out


def _state(
    name: str,
    state: StepState,
    capture: Capture | None,
    refused: Mapping[str, str],
    failures: Mapping[str, str],
    *,
    replaced: bool,
) -> tuple[ViewState, str]:
    if capture is not None:
        departs = [key for key, passed in capture.payload.verdicts.items() if not passed]
        return ("departs", f"not as required: {', '.join(departs)}") if departs else ("done", "")
    if name in refused:
        return "left_out", refused[name]
    if name in state.skipped_viewpoints:
        return "skipped", failures.get(name, "")
    if name in state.viewpoint_failures:
        return "failed", failures.get(name, "")
    return ("again", "") if replaced else ("open", "")


def _order(state: StepState) -> list[str]:
    taken = sorted(state.captured, key=lambda name: state.captured[name])
    return taken + [view.viewpoint for view in state.motion_plan.views]


def _refused(state: StepState) -> dict[str, str]:
    return {view.viewpoint: view.reason for view in state.motion_plan.views if view.outcome == "refused"}


def _place(log: RunRecord, capture: Capture) -> tuple[Vector, Vector] | tuple[None, None]:
    """Compute the camera position of an image that no plan lists, from the nominal T_flange_camera."""
    mount = nominal_T_flange_camera(log)
    if mount is None or not isinstance(capture.payload, ViewpointCaptured):
        return None, None
    return place(np.array(capture.payload.T_base_flange) @ np.array(mount))


# --- one image ---------------------------------------------------------------------------------------------------


def verdicts_of(log: RunRecord, step: Step, capture: Capture, others: Sequence[Capture]) -> list[Verdict]:
    """List the verdicts on an image, with their figures: sharp, exposed, spheres, pose, settings."""
    of_board = capture.payload.artefacts[0].kind == "board_image"
    found = [_board(log, step, capture)] if of_board else looked_at(capture.live, [o.live for o in others])
    return [*found, *_taken(log.protocol, capture)]


def _board(log: RunRecord, step: Step, capture: Capture) -> Verdict:
    """Return the verdict on whether the calibration uses an image of the board."""
    use, name = board_use(log.state.steps[step.id], capture.payload), capture.payload.viewpoint
    answer = calibration_in(log.state.steps[step.id])
    intrinsics = None if answer is None else answer.details.intrinsics
    if use.used and intrinsics is not None and intrinsics.per_view_rms_px:
        rms = dict(zip(intrinsics.images, intrinsics.per_view_rms_px, strict=True))[name]
        return Verdict("Board", True, "Found", f"corners {rms:.3f} px rms against the calibration")
    return Verdict("Board", use.used, use.word, use.why)


def looked_at(
    live: JobState | None, others: Sequence[JobState | None], fewest: int = FEWEST_SPHERES
) -> list[Verdict]:
    """List what the job that looked at an image says; `others` are the jobs of the same camera's images."""
    measures = {} if live is None else dict(live.measures)
    waiting = live is not None and live.status == "enqueued"
    unknown = "being looked at" if waiting else "not measured"
    out: list[Verdict] = []

    edge = measures.get("edge_width_px")
    known = [job.measures["edge_width_px"] for job in others if job and "edge_width_px" in job.measures]
    guide = max(_EDGE_PX, _EDGE_FACTOR * median(known)) if known else _EDGE_PX
    sharp = None if edge is None else edge <= guide
    words = {None: unknown, True: "Sharp", False: "Soft"}
    figures = "" if edge is None else f"edges {edge:.1f} px wide, outlines {measures['outline_rms_px']:.2f} px rms"
    out.append(Verdict("Sharpness", sharp, words[sharp], figures, f"guide ≤ {guide:.1f} px"))

    clipped = measures.get("clipped_fraction")
    exposed = None if clipped is None else clipped <= _CLIPPED
    words = {None: unknown, True: "Well exposed", False: "Overexposed"}
    figures = "" if clipped is None else f"{100 * clipped:.2f} % of the pixels clipped"
    out.append(Verdict("Exposure", exposed, words[exposed], figures, f"guide ≤ {100 * _CLIPPED:.0f} %"))

    spheres, expected = measures.get("spheres_seen"), measures.get("spheres_expected")
    seen = None if spheres is None else spheres >= max(fewest, expected or 0)
    words = {None: unknown, True: "All seen", False: "Some missing"}
    figures = "" if spheres is None else f"{spheres:.0f} seen"
    if expected is not None:
        figures += f", {expected:.0f} expected whole in the image"
    reason = "" if live is None else live.message
    if live is not None and live.status == "finished":
        kind = LIVE_VIEW if live.kind == LIVE_VIEW.name else FURTHER_VIEW
        reason = kind.read_answer(live.result).reason or live.message
    out.append(Verdict("Spheres", seen, words[seen], f"{figures}; {reason}".strip("; ") if reason else figures))

    return out


def _taken(protocol: Protocol, capture: Capture) -> list[Verdict]:
    """List the verdicts on an image when it was taken."""
    payload = capture.payload
    out: list[Verdict] = []
    if isinstance(payload, ViewpointCaptured):
        still = payload.verdicts.get("still")
        words = {None: "not judged", True: "Still", False: "Moved"}
        figures = (
            f"σ {_small(mm(payload.pose_sigma_m))} mm, {_small(mrad(payload.pose_sigma_rad))} mrad "
            f"over {payload.pose_samples} poses"
        )
        limit = f"limit {mm(protocol.settle.position_peak_to_peak_m):.3g} mm peak to peak"
        out.append(Verdict("Pose", still, words[still], figures, limit))

    demanded = protocol.camera
    limit = ""
    if demanded is not None:
        limit = f"wanted {_settings(demanded.aperture_f, demanded.exposure_s, demanded.iso)}"
    out.append(settings_verdict(payload.optics, payload.verdicts.get("settings"), limit))
    return out


def settings_verdict(camera: RecordedOptics, passed: bool | None, limit: str = "") -> Verdict:
    """Return the verdict on whether a photograph was taken with the settings that it should have."""
    words = {None: "not judged", True: "As wanted", False: "Differ"}
    figures = _settings(camera.aperture_f, camera.exposure_s, camera.iso)
    return Verdict("Settings", passed, words[passed], figures, limit)


def _small(value: float) -> str:
    return "< 0.0001" if value < 1e-4 else f"{value:.4f}"


def _settings(aperture_f: float | None, exposure_s: float | None, iso: float | None) -> str:
    parts: list[str] = []
    if aperture_f is not None:
        parts.append(f"f/{aperture_f:g}")
    if exposure_s is not None:
        parts.append(f"1/{1 / exposure_s:.0f} s" if exposure_s < 0.5 else f"{exposure_s:g} s")
    if iso is not None:
        parts.append(f"ISO {iso:.0f}")
    return " · ".join(parts)


def summary_of(step: Step, capture: Capture) -> list[Verdict]:
    """List what all images up to this one come to, against the step's gates where it has any."""
    measures = {} if capture.live is None else dict(capture.live.measures)
    out: list[Verdict] = []
    for measure, name, unit, factor, digits in (
        ("predicted_target_error_mm", "Predicted target error", "mm", 1.0, 3),
        ("specimen_coverage", "Specimen covered", "%", 100.0, 0),
        ("registration_rms_px", "Outlines and registration differ by", "px rms", 1.0, 2),
    ):
        if measure not in measures:
            continue
        value = measures[measure]
        gate = next((g for g in step.gates if g.measure == measure), None)
        passed = None
        limit = ""
        if gate is not None:
            passed = (gate.min is None or value >= gate.min) and (gate.max is None or value <= gate.max)
            low, high = (None if end is None else factor * end for end in (gate.min, gate.max))
            limit = f"allowed {limits(low, high)} {unit}"
        out.append(Verdict(name, passed, "", f"{factor * value:.{digits}f} {unit}", limit))
    return out


def redo_of(log: RunRecord, step: Step, view: StepViewpoint, account: str) -> ViewpointRedo:
    """Return whether a viewpoint may be redone now. While the step runs, the robot then drives there by itself."""
    action = OperatorAction(action="redo", step=step.id, viewpoint=view.name, reason="asked", via="web")
    refusal = refuse(log.protocol, log.state, action, account)
    return ViewpointRedo(
        refused="" if refusal is None else ". ".join(filter(None, (refusal.what, refusal.remedy))),
        current=log.state.current,
        attempt=log.state.step.attempt,
        moves=redo_moves(log.protocol, log.state, step.id),
        paused=log.state.paused,
    )


def suggestions_of(log: RunRecord, step: Step) -> tuple[str, tuple[Suggestion, ...]]:
    """Say what the step's images lack and which views would help most; empty if they lack nothing."""
    state = log.state.steps[step.id]
    notes = suggested_views(state)
    if notes:
        return notes[-1].advice, notes[-1].viewpoints
    jobs = [job for job in state.jobs.values() if job.kind == LIVE_SUMMARY.name and job.status == "finished"]
    return "", LIVE_SUMMARY.read_answer(jobs[-1].result).next_best_views if jobs else ()


_FEWEST_SPHERES = 4  # that locate a further camera
_MOUNTED = {"fixed": "in the room", "rigid": "beside the first camera"}
_SHEET_SPHERES = "spheres_seen"


@dataclass(frozen=True, slots=True)
class CameraImage:
    """The image of one camera at the viewpoint that is shown.

    Attributes:
        device: name of a further camera in rig.yaml; "" for the first one.
        place: a text on where the camera is.
        sha256: hash of the photograph.
        width, height: size of the photograph as it states it, px.
        verdicts: the verdicts on this image.
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
    """Return the images of all cameras at the viewpoint of a capture, the first camera's first.

    Args:
        log: the run's record.
        capture: the viewpoint's capture.
        verdicts: the verdicts on the first camera's image.
        others: valid captures of the step, whose images each camera's is compared with.
    """
    size = capture.payload.optics
    images = [CameraImage("", "on the arm", capture.sha256, size.width or 3, size.height or 2, verdicts)]
    beside = {name: [job.live for job in mine] for name, mine in _by_device(log, others).items()}
    for one in further_of(log, capture):
        stated, device = one.exposure.optics, one.exposure.device
        found = looked_at(one.live, beside.get(device, ()), _FEWEST_SPHERES)
        found.append(settings_verdict(stated, one.exposure.verdicts.get("settings")))
        place = _MOUNTED[one.exposure.mounted]
        images.append(CameraImage(device, place, one.sha256, stated.width or 3, stated.height or 2, found))
    return images


def devices_in(log: RunRecord, captures: Sequence[Capture]) -> list[str]:
    """Return the further cameras that took any of these images."""
    return list(_by_device(log, captures))


def _by_device(log: RunRecord, captures: Sequence[Capture]) -> dict[str, list[FurtherCapture]]:
    found: dict[str, list[FurtherCapture]] = {}
    for capture in captures:
        for one in further_of(log, capture):
            found.setdefault(one.exposure.device, []).append(one)
    return found


def sheet_image(log: RunRecord, capture: Capture, uses: Mapping[str, BoardUse], device: str) -> SheetImage | None:
    """Return a capture as the contact sheet shows it; None if this further camera did not expose there."""
    if device:
        mine = next((one for one in further_of(log, capture) if one.exposure.device == device), None)
        return None if mine is None else _of_further(capture, mine)
    size = capture.payload.optics
    word, tone, why = _word(capture, uses.get(capture.sha256))
    return SheetImage(capture, capture.sha256, size.width or 3, size.height or 2, word, tone, why)


def _of_further(capture: Capture, mine: FurtherCapture) -> SheetImage:
    size = mine.exposure.optics
    if capture.replaced is not None:
        word, tone, why = "Replaced", "quiet", capture.replaced.reason
    elif mine.exposure.verdicts.get("settings") is False:
        word, tone, why = "Departs", "attention", ""
    else:
        word, tone, why = _spheres(mine.live.measures if mine.live else {}, _FEWEST_SPHERES)
    return SheetImage(capture, mine.sha256, size.width or 3, size.height or 2, word, tone, why)


def _word(capture: Capture, use: BoardUse | None) -> tuple[str, str, str]:
    """Return the word, tone and reason for an image of the first camera."""
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


# --- the viewpoints of a station seen from above: the robot's side is at the bottom -------------------------------

WIDTH = 640.0  # of the drawing; its height follows from what is on it
_MARGIN = 62.0
_TICK = 30.0  # length of the line that shows where a camera looks
_MOST_LABELS = 40
_MOST_SYMBOLS = 400  # beyond this, viewpoints that would overlap are drawn as one
_CELL = 6.0  # edge of the square within which viewpoints overlap
# Which of them is drawn: those that need attention come first.
_FIRST: Sequence[ViewState] = ("failed", "again", "unused", "departs", "left_out", "skipped", "open", "done", "next")


@dataclass(frozen=True, slots=True)
class Symbol:
    """A viewpoint on the drawing."""

    name: str
    label: str  # short, "" where there is no room
    state: ViewState
    x: float
    y: float
    tip_x: float  # tip of the line towards what it looks at
    tip_y: float


@dataclass(frozen=True, slots=True)
class PlanDrawing:
    """One station from above, in units of the drawing.

    Attributes:
        specimen: left, top, width, height.
        bar: length of 100 mm.
        robot: the place of its base; None when it is outside of the drawing (below it).
    """

    station: str
    merged: bool  # some symbols stand for several viewpoints
    width: float
    height: float
    symbols: tuple[Symbol, ...]
    specimen: tuple[float, float, float, float]
    bar: float
    robot: tuple[float, float] | None


def plan_drawing(station: StationPlan, views: Sequence[StepViewpoint], chosen: str = "") -> PlanDrawing | None:
    """Return the drawing; None without a viewpoint whose position is known. `chosen` is always drawn."""
    placed = [(v, v.position_m, v.looks) for v in views if v.position_m is not None and v.looks is not None]
    if not placed:
        return None
    layout = station.layout
    points = [_above(position, layout.scene_centre_m, layout.approach) for _, position, _ in placed]
    deep, across = station.specimen_m
    xs = [x for x, _ in points] + [-across / 2, across / 2]
    ys = [y for _, y in points] + [-deep / 2, deep / 2]
    left, right, top, bottom = min(xs), max(xs), min(ys), max(ys)
    scale = min((WIDTH - 2 * _MARGIN) / max(right - left, 0.1), 600.0 / max(bottom - top, 0.1))
    shift = (WIDTH - scale * (right - left)) / 2
    height = scale * (bottom - top) + 2 * _MARGIN

    def at(x: float, y: float) -> tuple[float, float]:
        return round(shift + scale * (x - left), 1), round(_MARGIN + scale * (y - top), 1)

    every: list[Symbol] = []
    for (view, _, looks), point in zip(placed, points, strict=True):
        x, y = at(*point)
        dx, dy = _above(looks, (0.0, 0.0, 0.0), layout.approach)
        length = math.hypot(dx, dy)
        reach = 0.0 if length < 0.05 else _TICK / length * min(1.0, length / 0.3)
        label = _short(view.name) if len(placed) <= _MOST_LABELS else ""
        every.append(Symbol(view.name, label, view.state, x, y, round(x + reach * dx, 1), round(y + reach * dy, 1)))
    symbols = every if len(every) <= _MOST_SYMBOLS else _apart(every, chosen)
    corner, far = at(-across / 2, -deep / 2), at(across / 2, deep / 2)
    base = at(*_above((0.0, 0.0, 0.0), layout.scene_centre_m, layout.approach))
    inside = 0 <= base[0] <= WIDTH and 0 <= base[1] <= height
    return PlanDrawing(
        station=layout.name,
        merged=len(symbols) < len(every),
        width=WIDTH,
        height=round(height, 1),
        symbols=tuple(symbols),
        specimen=(corner[0], corner[1], round(far[0] - corner[0], 1), round(far[1] - corner[1], 1)),
        bar=round(0.1 * scale, 1),
        robot=base if inside else None,
    )


def _apart(symbols: Sequence[Symbol], chosen: str) -> list[Symbol]:
    """Return one of the viewpoints that would overlap each other, and always the chosen and the next viewpoint."""
    wanted = [symbol for symbol in symbols if symbol.name == chosen or symbol.state == "next"]
    kept: dict[tuple[int, int], Symbol] = {}
    for symbol in sorted(symbols, key=lambda s: _FIRST.index(s.state)):
        kept.setdefault((int(symbol.x // _CELL), int(symbol.y // _CELL)), symbol)
    return [*(symbol for symbol in kept.values() if symbol not in wanted), *wanted]


def _short(name: str) -> str:
    """Shorten a name: v1_003 → 3; a name without a number stays."""
    number = re.search(r"(\d+)$", name)
    return number.group(1).lstrip("0") if number and not re.search(r"t\d+[+-]\d+$", name) else name


def _above(point: Vector, origin: Vector, approach: Vector) -> tuple[float, float]:
    """Return metres to the right and down the page of a point seen from above, the robot below."""
    x, y = point[0] - origin[0], point[1] - origin[1]
    side = (-approach[1], approach[0])  # up × approach
    return x * side[0] + y * side[1], x * approach[0] + y * approach[1]
