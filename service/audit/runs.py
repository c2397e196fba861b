"""Several runs at once: a search by what people wrote, time and result, and figures over time by instrument."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import ValidationError
from sqlalchemy import Connection, text

from service.audit.filters import Result, RunSearch
from service.audit.queries import RunBasics, plain_payload, runs
from service.core.recorded_devices import RecordedIdentity, recorded_identity
from service.core.records.run_events import GatesEvaluated, RecordedOptics, recorded_optics
from service.store.runs import read_open_runs
from service.store.store import Store

# --- the search ---------------------------------------------------------------------------------------------------

RESULT_WORDS: Mapping[Result, str] = {
    "open": "not ended",
    "completed": "completed",
    "aborted": "ended early",
    "within": "accuracy within its limit",
    "outside": "accuracy outside its limit",
    "released": "released",
}
_ERROR = "mean_radial_error_mm"  # the measure of an evaluation that is shown as the accuracy of the run


@dataclass(frozen=True, slots=True)
class Accuracy:
    """The mean radial error on the control spheres, as it was last judged."""

    error_mm: float
    most_mm: float | None
    within: bool | None  # None: not decided, because a limit lies within its uncertainty

    @property
    def words(self) -> str:
        """`0.213 mm (within)`."""
        how = {True: "within", False: "outside", None: "not decided"}[self.within]
        return f"{self.error_mm:.3f} mm ({how})"


@dataclass(frozen=True, slots=True)
class FoundRun:
    """A run in a list."""

    basics: RunBasics
    notes: tuple[str, ...]
    status: Literal["open", "completed", "aborted"]
    released: bool
    accuracy: Accuracy | None

    def has(self, result: str) -> bool:
        """Return whether the run has this result, one of RESULTS."""
        if result == "released":
            return self.released
        if result in ("within", "outside"):
            return self.accuracy is not None and self.accuracy.within is (result == "within")
        return self.status == result

    @property
    def words(self) -> str:
        """The text that is searched, in lower case."""
        run, said = self.basics, self.basics.about.model_dump().values()
        parts = (run.run_id, run.protocol, run.version, run.operator, *said, *self.notes)
        return "\n".join(map(str, parts)).casefold()


def find_runs(store: Store, wanted: RunSearch) -> list[FoundRun]:
    """Return the runs that match, newest first. If a first event cannot be read, its fields are empty."""
    with store.database.reading() as connection:
        every = _every(connection)
    terms = wanted.q.casefold().split()
    return [
        run
        for run in every
        if (not wanted.since or wanted.since <= run.basics.created_utc[:10])
        and (not wanted.until or run.basics.created_utc[:10] <= wanted.until)
        and (not wanted.result or run.has(wanted.result))
        and (not terms or all(term in run.words for term in terms))
    ]


def _every(connection: Connection) -> list[FoundRun]:
    still_open = read_open_runs(connection)
    ended = {run for run, _ in _of_kind(connection, "run_completed")}
    released = {run for run, _ in _of_kind(connection, "run_released")}
    notes: dict[str, list[str]] = defaultdict(list)
    for run, payload in _of_kind(connection, "note_taken"):
        said = plain_payload(payload).get("text")
        if isinstance(said, str):
            notes[run].append(said)
    judged = dict(_of_kind(connection, "gates_evaluated", _ERROR))
    return [
        FoundRun(
            basics=run,
            notes=tuple(notes.get(run.run_id, ())),
            status="open" if run.run_id in still_open else "completed" if run.run_id in ended else "aborted",
            released=run.run_id in released,
            accuracy=_accuracy(judged.get(run.run_id, "")),
        )
        for run in runs(connection)
    ]


def _of_kind(connection: Connection, kind: str, word: str = "") -> Sequence[tuple[str, str]]:
    """Return run and payload of each event of a kind whose payload has this word, in order."""
    rows = connection.execute(
        text(
            # Run by run, in the order of the index, to avoid reading every event of the folder.
            "SELECT i.run_id, e.payload FROM runs AS r CROSS JOIN event_index AS i CROSS JOIN events AS e "
            "WHERE i.run_id = r.run_id AND i.kind = :kind AND e.run_id = i.run_id AND e.seq = i.seq "
            "AND e.payload LIKE :word ORDER BY i.run_id, i.seq"
        ),
        {"kind": kind, "word": f"%{word}%"},
    )
    return [(str(row.run_id), str(row.payload)) for row in rows]


def _accuracy(payload: str) -> Accuracy | None:
    try:
        verdicts = GatesEvaluated.model_validate_json(payload).verdicts if payload else ()
    except ValidationError:  # the verification reports it
        return None
    for judged in verdicts:
        if judged.measure.endswith(_ERROR) and judged.value is not None:
            return Accuracy(judged.value, judged.maximum, None if judged.undecided else judged.passed)
    return None


# --- calibration and accuracy over time: one row for each run that has such figures -------------------------------

InstrumentKind = Literal["camera", "lens", "arm"]


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure that is followed over time: its name, its unit, and the instruments that it describes."""

    key: str
    name: str
    unit: str
    of: tuple[InstrumentKind, ...]
    from_zero: bool = True  # its axis starts at 0; a focal length changes by a thousandth only


FIGURES: tuple[Figure, ...] = (
    Figure("rms_px", "Residual of the intrinsics (rms)", "px", ("camera", "lens")),
    Figure("uncertainty_mm", "Uncertainty of a projection, worst in the image", "mm", ("camera", "lens")),
    Figure("fx_px", "Focal length fx", "px", ("lens",), from_zero=False),
    Figure("cx_px", "Principal point cx", "px", ("camera",), from_zero=False),
    Figure("hand_eye_held_out_mm", "Hand-eye error of held-out images (median)", "mm", ("arm",)),
    Figure("hand_eye_sigma_mm", "Uncertainty of the hand-eye transform (σ)", "mm", ("arm",)),
    Figure("robot_noise_mm", "Noise of the arm's poses", "mm", ("arm",)),
    Figure("mean_radial_error_mm", "Accuracy: mean radial error", "mm", ("camera", "lens", "arm")),
)
_MEASURED = (
    "rms_px",
    "five_fold_rms_px",
    "uncertainty_mm",
    "hand_eye_sigma_mm",
    "hand_eye_held_out_mm",
    "robot_noise_mm",
)
_OF_CAMERA = ("fx", "fy", "cx", "cy")
_COLUMNS = (*_MEASURED, *(f"{name}_px" for name in _OF_CAMERA), "mean_radial_error_mm")


@dataclass(frozen=True, slots=True)
class Instrument:
    """A camera, lens or arm by the maker's model and serial number; "" if not known."""

    kind: InstrumentKind
    model: str
    serial: str

    @property
    def name(self) -> str:
        """`ILCE-7RM5, serial number 1234567`."""
        return f"{self.model or 'model not stated'}, serial number {self.serial or 'not stated'}"


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """The figures of one run, with the time of its calibration or, without one, of its beginning."""

    run: FoundRun
    at_utc: str
    camera: Instrument | None
    lens: Instrument | None
    arms: tuple[Instrument, ...]  # the arms whose flange carried the camera
    values: Mapping[str, float]

    def instruments(self) -> tuple[Instrument, ...]:
        """Return all instruments of the run."""
        return tuple(one for one in (self.camera, self.lens, *self.arms) if one is not None)


def history(store: Store) -> list[HistoryRow]:
    """Return every run with a calibration or an accuracy, oldest first."""
    runs = find_runs(store, RunSearch())[::-1]
    with store.database.reading() as connection:
        calibrations = _calibrations(connection)
        devices = _devices(connection)
        optics = _optics(connection)
    rows: list[HistoryRow] = []
    for run in runs:
        steps = calibrations.get(run.basics.run_id, ())
        values = _values(steps)
        if run.accuracy is not None:
            values["mean_radial_error_mm"] = run.accuracy.error_mm
        if values:
            at_utc = max((step.at_utc for step in steps), default=run.basics.created_utc)
            mine = devices.get(run.basics.run_id, {})
            rows.append(
                HistoryRow(
                    run,
                    at_utc,
                    *_optical(mine, optics.get(run.basics.run_id, RecordedOptics())),
                    _arms(mine, steps),
                    values,
                )
            )
    return sorted(rows, key=lambda row: row.at_utc)


def by_instrument(rows: Sequence[HistoryRow]) -> dict[Instrument, list[HistoryRow]]:
    """Return the rows of each instrument: cameras, then lenses, then arms, each sorted by model and serial number."""
    found: dict[Instrument, list[HistoryRow]] = defaultdict(list)
    for row in rows:
        for instrument in row.instruments():
            found[instrument].append(row)
    order = ("camera", "lens", "arm")
    return {one: found[one] for one in sorted(found, key=lambda i: (order.index(i.kind), i.model, i.serial))}


# --- reading -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _CalibrationResult:
    """The last result of one calibration step."""

    at_utc: str
    measures: Mapping[str, float]
    camera: Mapping[str, float]
    robots: tuple[str, ...]


_OF_KIND = text(
    "SELECT e.run_id, e.at_utc, e.payload FROM runs AS r CROSS JOIN event_index AS i CROSS JOIN events AS e "
    "WHERE i.run_id = r.run_id AND i.kind = :kind AND e.run_id = i.run_id AND e.seq = i.seq "
    "AND e.payload LIKE :word ORDER BY e.run_id, e.seq"
)


def _calibrations(connection: Connection) -> dict[str, tuple[_CalibrationResult, ...]]:
    found: dict[str, dict[str, _CalibrationResult]] = defaultdict(dict)
    for row in connection.execute(_OF_KIND, {"kind": "step_measured", "word": '%"camera":{%'}):
        payload = plain_payload(row.payload)
        measures, result = _numbers(payload.get("measures")), payload.get("result") or {}
        if isinstance(result.get("camera"), dict) and any(name in measures for name in _MEASURED):
            found[row.run_id][str(payload.get("step"))] = _CalibrationResult(
                row.at_utc, measures, _numbers(result["camera"]), tuple(map(str, result.get("robots") or ()))
            )
    return {run: tuple(steps.values()) for run, steps in found.items()}


def _devices(connection: Connection) -> dict[str, dict[str, RecordedIdentity]]:
    """Return by run and name in rig.yaml the identity that a device reported when it was last opened."""
    found: dict[str, dict[str, RecordedIdentity]] = defaultdict(dict)
    for row in connection.execute(_OF_KIND, {"kind": "device_opened", "word": '%"identity":{%'}):
        payload = plain_payload(row.payload)
        identity = (payload.get("report") or {}).get("identity")
        if isinstance(identity, dict):
            found[row.run_id][str(payload.get("device"))] = recorded_identity(identity)
    return found


def _optics(connection: Connection) -> dict[str, RecordedOptics]:
    """Return by run what the first photograph states of camera and lens."""
    rows = connection.execute(
        text(
            "SELECT e.run_id, e.payload FROM runs AS r CROSS JOIN events AS e "
            "WHERE e.run_id = r.run_id AND e.seq = (SELECT min(i.seq) FROM event_index AS i "
            "WHERE i.run_id = r.run_id AND i.kind IN ('viewpoint_captured', 'view_held', 'view_imported'))"
        )
    )
    stated = {row.run_id: plain_payload(row.payload).get("camera") for row in rows}
    return {run: recorded_optics(camera) for run, camera in stated.items() if camera}


def _numbers(content: Mapping[str, object] | None) -> dict[str, float]:
    read = content or {}
    return {name: float(v) for name, v in read.items() if isinstance(v, int | float) and not isinstance(v, bool)}


def _values(steps: Iterable[_CalibrationResult]) -> dict[str, float]:
    values: dict[str, float] = {}
    for step in steps:
        values |= {name: step.measures[name] for name in _MEASURED if name in step.measures}
        values |= {f"{name}_px": step.camera[name] for name in _OF_CAMERA if name in step.camera}
    return values


def _optical(
    devices: Mapping[str, RecordedIdentity], stated: RecordedOptics
) -> tuple[Instrument | None, Instrument | None]:
    """Return the camera and lens as the photographs state them, else as the camera reported when it was opened."""
    cameras = (one for name, one in devices.items() if one.kind == "camera" or name == "camera")
    answered = next(cameras, RecordedIdentity())
    model, serial = stated.model or answered.model, stated.body_serial or answered.serial
    return (
        Instrument("camera", model, serial) if model or serial else None,
        Instrument("lens", stated.lens, stated.lens_serial) if stated.lens or stated.lens_serial else None,
    )


def _arms(devices: Mapping[str, RecordedIdentity], steps: Sequence[_CalibrationResult]) -> tuple[Instrument, ...]:
    """Return the arms that the calibration names; if it names none, every arm that was opened."""
    named = dict.fromkeys(robot for step in steps for robot in step.robots)
    names = named or [name for name, i in devices.items() if i.kind == "robot" or name.startswith("robot")]
    arms = (devices[name] for name in names if name in devices)
    return tuple(dict.fromkeys(Instrument("arm", arm.model, arm.serial) for arm in arms))


# --- CSV -------------------------------------------------------------------------------------------------------


def history_csv(rows: Sequence[HistoryRow]) -> str:
    """Return the rows as CSV (RFC 4180) with a header line; units are in the names."""
    out = io.StringIO()
    writer = csv.writer(out)
    about = ("run", "at_utc", "simulated", "state", "specimen", "purpose", "site", "protocol", "version")
    instruments = ("camera_model", "camera_serial", "lens", "lens_serial", "arm_models", "arm_serials")
    writer.writerow([*about, *instruments, *_COLUMNS, "mean_radial_error_limit_mm", "accuracy"])
    for row in rows:
        run, about, accuracy = row.run.basics, row.run.basics.about, row.run.accuracy
        arms = [" + ".join(getattr(arm, field) for arm in row.arms) for field in ("model", "serial")]
        optical = [
            getattr(one, field) if one else "" for one in (row.camera, row.lens) for field in ("model", "serial")
        ]
        words = (
            run.run_id, row.at_utc, "yes" if run.simulated else "no", row.run.status, about.specimen,
            about.purpose, about.site, run.protocol, run.version, *optical, *arms,
        )  # fmt: skip
        judged = "" if accuracy is None else {True: "within", False: "outside", None: "not decided"}[accuracy.within]
        limit = "" if accuracy is None or accuracy.most_mm is None else f"{accuracy.most_mm:g}"
        numbers = [f"{row.values[name]:.9g}" if name in row.values else "" for name in _COLUMNS]
        writer.writerow([*map(_harmless, words), *numbers, limit, judged])
    return out.getvalue()


def _harmless(word: str) -> str:
    """Return the text, with an apostrophe in front if a spreadsheet would take it for a formula."""
    return f"'{word}" if word.startswith(("=", "+", "-", "@", "\t")) else word
