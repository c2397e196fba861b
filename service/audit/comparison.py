"""A comparison of two runs: protocol, figures and gates, accuracy, calibration, durations, deviations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from service.computations.calibration import CALIBRATE
from service.computations.evaluate import Row
from service.computations.records import Camera
from service.core.gates import figure, limits, quantity, standing
from service.core.geometry import Transform
from service.core.records.entered import ABOUT, RunAbout
from service.core.records.run_events import GateVerdict
from service.core.run.fold import FoldedRun
from service.core.run.state import StepState
from service.core.units import mm
from service.dataset.registrations import evaluated
from service.followed_run import RunRecord
from service.people.approvals import difference

_UNITS = {"_px": "px", "_mm": "mm", "_deg": "°", "_min": "min"}  # by the end of a measure's name
_STANDINGS = {
    "within": "within",
    "not_decided": "not decided",
    "accepted": "accepted outside",
    "outside": "outside",
}


@dataclass(frozen=True, slots=True)
class ComparedRun(FoldedRun):
    """One of the compared runs."""

    source: str  # text of the protocol

    @classmethod
    def of(cls, log: RunRecord) -> ComparedRun:
        """Return a run with its protocol's text. Raises IntegrityError if the text was altered."""
        source = log.store.artefact_path(log.root.protocol.sha256, verify=True).read_text("utf-8")
        return cls(log.run_id, log.protocol, log.events, log.state, source)


@dataclass(frozen=True, slots=True)
class ComparedProperty:
    """One property of both runs as text; `change`: from the first to the second, "" if there is none."""

    name: str
    first: str
    second: str
    change: str = ""
    differs: bool = False
    step: str = ""  # title of the step that it belongs to


@dataclass(frozen=True, slots=True)
class RunComparison:
    """Two runs and their comparison."""

    first: ComparedRun
    second: ComparedRun
    about: tuple[ComparedProperty, ...]
    same_protocol: bool
    protocol_changes: tuple[str, ...]  # lines with − are of the first run, with + of the second
    gates: tuple[ComparedProperty, ...]
    measures: tuple[ComparedProperty, ...]
    accuracy: tuple[ComparedProperty, ...]
    calibration: tuple[ComparedProperty, ...]
    durations: tuple[ComparedProperty, ...]
    deviations: tuple[tuple[str, ...], tuple[str, ...]]


def compare_runs(first: ComparedRun, second: ComparedRun) -> RunComparison:
    """Compare two runs. What only one of them has is listed too."""
    same = first.root.protocol_sha256 == second.root.protocol_sha256
    return RunComparison(
        first=first,
        second=second,
        about=tuple(_about(first, second)),
        same_protocol=same,
        protocol_changes=() if same else tuple(difference(first.source, second.source)),
        gates=tuple(_gates(first, second)),
        measures=tuple(_measures(first, second)),
        accuracy=tuple(_accuracy(first, second)),
        calibration=tuple(_calibration(first, second)),
        durations=tuple(_durations(first, second)),
        deviations=(_deviations(first), _deviations(second)),
    )


def _row(name: str, first: str, second: str, *, change: str = "", step: str = "") -> ComparedProperty:
    return ComparedProperty(name, first or "–", second or "–", change, first != second, step)


def _about(first: ComparedRun, second: ComparedRun) -> Iterable[ComparedProperty]:
    said = [run.root.about or RunAbout() for run in (first, second)]
    for field, name in ABOUT.items():
        pair = [str(getattr(about, field)) for about in said]
        if any(pair):
            yield _row(name, *pair)
    yield _row("Started (UTC)", *(run.events[0].at_utc[:19].replace("T", " ") for run in (first, second)))
    yield _row("Started by", first.root.operator, second.root.operator)
    yield _row("Protocol", *(f"{run.protocol.id} {run.protocol.version}" for run in (first, second)))
    yield _row("State", first.state.status, second.state.status)
    yield _row("Rig", *("simulated" if run.root.simulated else "real" for run in (first, second)))


def _steps(first: ComparedRun, second: ComparedRun) -> list[tuple[str, str]]:
    """Return identifier and title of every step, as the first run orders them; steps of the second alone are last."""
    titles = {step.id: step.title for run in (second, first) for step in run.protocol.steps}
    return [(name, titles[name]) for name in dict.fromkeys([*first.protocol.step_ids, *second.protocol.step_ids])]


def _state(run: ComparedRun, step: str) -> StepState:
    return run.state.steps.get(step) or StepState(step)


def _gates(first: ComparedRun, second: ComparedRun) -> Iterable[ComparedProperty]:
    for step, title in _steps(first, second):
        states = _state(first, step), _state(second, step)
        verdicts = [{v.measure: v for v in state.verdicts} for state in states]
        for measure in dict.fromkeys([*verdicts[0], *verdicts[1]]):
            judged = [there.get(measure) for there in verdicts]
            texts = [_judged(v, state) for v, state in zip(judged, states, strict=True)]
            values = [None if v is None else v.value for v in judged]
            unit = next((v.unit for v in judged if v is not None), "")
            yield _row(measure, *texts, change=_change(values, unit), step=title)


def _judged(verdict: GateVerdict | None, state: StepState) -> str:
    if verdict is None:
        return ""
    how = _STANDINGS[standing(verdict, accepted=state.accepted is not None)]
    return f"{figure(verdict)} ({limits(verdict.minimum, verdict.maximum)}): {how}"


def _measures(first: ComparedRun, second: ComparedRun) -> Iterable[ComparedProperty]:
    for step, title in _steps(first, second):
        numbers = _state(first, step).measures, _state(second, step).measures
        for measure in dict.fromkeys([*numbers[0], *numbers[1]]):
            values = [there.get(measure) for there in numbers]
            unit = _unit(measure)
            texts = ["" if value is None else quantity(value, unit) for value in values]
            yield _row(measure, *texts, change=_change(values, unit), step=title)


def _unit(name: str) -> str:
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def _change(values: Sequence[float | None], unit: str = "") -> str:
    """Return the change as text, such as `+0.012 mm`; "" if a value is missing or both are equal."""
    first, second = values
    if first is None or second is None or not math.isfinite(apart := second - first) or apart == 0:
        return ""
    return f"{apart:+.4g} {unit}".rstrip().replace("-", "−", 1)


_ERRORS: tuple[tuple[str, str, Callable[[Row], float | None]], ...] = (
    ("mean radial error", "mm", lambda row: row.mean_radial_error_mm),
    ("predicted error", "mm", lambda row: row.predicted_error_mm),
    ("reprojection", "px", lambda row: row.mean_reprojection_error_px),
)


def _accuracy(first: ComparedRun, second: ComparedRun) -> Iterable[ComparedProperty]:
    tables = [{row.poses: row for row in evaluated(run.protocol, run.state)} for run in (first, second)]
    for poses in dict.fromkeys([*tables[0], *tables[1]]):
        rows = [table.get(poses) for table in tables]
        for name, unit, value_of in _ERRORS:
            values = [None if row is None else value_of(row) for row in rows]
            if any(value is not None for value in values):
                texts = ["" if value is None else f"{value:.3f} {unit}" for value in values]
                yield _row(name, *texts, change=_change(values, unit), step=poses)


# Parameters of the camera.
_CAMERA = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_OF_CALIBRATION = (
    "rms_px", "five_fold_rms_px", "coverage", "uncertainty_mm", "hand_eye_sigma_mm", "hand_eye_sigma_deg",
    "hand_eye_held_out_mm", "hand_eye_held_out_deg", "robot_noise_mm", "robot_noise_deg",
)  # fmt: skip


def _calibration(first: ComparedRun, second: ComparedRun) -> Iterable[ComparedProperty]:
    found = [_calibrated(run) for run in (first, second)]
    for name in _CAMERA:
        values = [one.parameter(name) for one in found]
        if any(value is not None for value in values):
            unit = "px" if name in ("fx", "fy", "cx", "cy") else ""
            texts = ["" if value is None else f"{value:.6g} {unit}".rstrip() for value in values]
            yield _row(f"Camera {name}", *texts, change=_change(values, unit))
    for name in _OF_CALIBRATION:
        values = [one.measures.get(name) for one in found]
        if any(value is not None for value in values):
            unit = _unit(name)
            texts = ["" if value is None else quantity(value, unit) for value in values]
            yield _row(name, *texts, change=_change(values, unit))
    here, there = (one.T_flange_camera for one in found)
    if here is not None and there is not None:
        moved_mm = mm(float(np.linalg.norm(there[:3, 3] - here[:3, 3])))
        turned = here[:3, :3].T @ there[:3, :3]
        turned_deg = math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(turned)) - 1) / 2))))
        where = [f"{mm(T[0, 3]):.2f}, {mm(T[1, 3]):.2f}, {mm(T[2, 3]):.2f} mm" for T in (here, there)]
        change = f"{moved_mm:.3f} mm, {turned_deg:.4f}°" if not np.array_equal(here, there) else ""
        yield _row("Camera on the flange", *where, change=change)


@dataclass(frozen=True, slots=True)
class _Calibrated:
    """The camera and T_flange_camera (4, 4) that were solved last, and the measures of all calibration steps."""

    camera: Camera | None
    T_flange_camera: Transform | None
    measures: Mapping[str, float]

    def parameter(self, name: str) -> float | None:
        """Return a parameter of the camera; None where it was not recorded."""
        if self.camera is None or name not in self.camera.model_fields_set:
            return None
        return float(getattr(self.camera, name))


def _calibrated(run: ComparedRun) -> _Calibrated:
    camera: Camera | None = None
    T_flange_camera: Transform | None = None
    measures: dict[str, float] = {}
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        if step.gives == "calibration" and state.result:
            answer = CALIBRATE.read_answer(state.result)
            camera = answer.camera
            if answer.T_flange_camera is not None:
                T_flange_camera = np.array(answer.T_flange_camera, dtype=np.float64)
            measures |= state.measures
    return _Calibrated(camera, T_flange_camera, measures)


def _durations(first: ComparedRun, second: ComparedRun) -> Iterable[ComparedProperty]:
    for step, title in _steps(first, second):
        seconds = [
            _between(state.started_utc, state.ended_utc) for state in (_state(first, step), _state(second, step))
        ]
        if any(value is not None for value in seconds):
            yield _row(title, *map(_took, seconds), change=_longer(*seconds))
    whole = [_between(run.events[0].at_utc, run.state.ended_utc) for run in (first, second)]
    if any(value is not None for value in whole):
        yield _row("Whole run", *map(_took, whole), change=_longer(*whole))


def _between(begun: str, ended: str) -> float | None:
    if not begun or not ended:
        return None
    return (datetime.fromisoformat(ended) - datetime.fromisoformat(begun)).total_seconds()


def _took(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes, rest = divmod(abs(seconds), 60)
    hours, minutes = divmod(int(minutes), 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02.0f} s" if minutes else f"{rest:.1f} s"


def _longer(first: float | None, second: float | None) -> str:
    if first is None or second is None or _took(first) == _took(second):
        return ""
    return ("+" if second > first else "−") + _took(second - first)


def _deviations(run: ComparedRun) -> tuple[str, ...]:
    return tuple(
        f"{d.kind.replace('_', ' ')}: {d.text}" + (f" ({d.actor})" if d.actor else "") for d in run.state.deviations
    )
