"""The pure part of verification: rows and hashes in, faults out; and whether each view's pose fits its joints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal

from pydantic_core import ValidationError

from service.core.errors import StoreError
from service.core.recorded_devices import recorded_report
from service.core.records.base import ArtefactRef
from service.core.records.events import PAYLOAD, SignaturesWrittenAgain
from service.core.units import deg, mm
from service.core.words import counted
from service.store.artefacts import record_sha256
from service.store.events import ROOT, canonical_parsed, event_sha256_of_text, parse_canonical, references
from service.store.records import SITE

if TYPE_CHECKING:
    from service.core.arms import ArmModel

# Whether the pose of each recorded view fits the joints recorded with it: a tool changed unseen shows here.
#
# Only arms whose controllers report the pose of the tool are judged. Others report the flange, whatever the tool.


NOT_COMPARED = " are not compared, because "  # in every sentence on views that are not judged


@dataclass(frozen=True, slots=True)
class ReportedPose:
    """A view's place as a viewpoint_captured event holds it: its name, and where the controller had the arm."""

    step: str
    viewpoint: str
    station: str
    joints_rad: Sequence[float]  # (N,)
    T_base_flange: Sequence[Sequence[float]]  # (4, 4)


@dataclass(frozen=True, slots=True)
class AwayView:
    """A view whose pose does not fit its joints, by so much."""

    seq: int
    viewpoint: str
    distance_m: float
    angle_rad: float

    def __str__(self) -> str:
        return (
            f"the pose of {self.viewpoint} is {mm(self.distance_m):.0f} mm and {deg(self.angle_rad):.1f}° from where "
            "its recorded joints put the flange: the tool at the controller was not the one reckoned with"
        )


@dataclass(frozen=True, slots=True)
class _OpenedArm:
    """An arm as it was opened: its model's name, and its kinematics or why its views cannot be judged."""

    model: str
    kinematics: ArmModel | None
    why_not: str = ""

    @classmethod
    def of(cls, model: str) -> _OpenedArm:
        from service.core.arms import known_arm  # noqa: PLC0415 - searches for plug-ins

        arm = known_arm(model)
        if arm is None:
            return cls(model, None, f"no kinematics are known for an arm {model!r}")
        if arm.family != "universal_robot":
            return cls(model, None, f"the controller of an arm {model} reports the flange, whatever its tool")
        return cls(model, arm)


@dataclass
class PoseFacts:
    """The arms of a run, those of its views whose pose does not fit their joints, and those that cannot be judged."""

    _arms: dict[str, _OpenedArm] = field(default_factory=dict[str, _OpenedArm])
    _unjudged: Counter[str] = field(default_factory=Counter[str])  # reason → number of views
    _away: dict[int, AwayView] = field(default_factory=dict[int, AwayView])
    _last: dict[tuple[str, ...], int] = field(default_factory=dict[tuple[str, ...], int])  # view → its newest event

    def open(self, device: str, report: object) -> None:
        """Add a device_opened event: the device's name in rig.yaml, and its DeviceReport as plain data."""
        identity = recorded_report(report).identity
        if identity.kind == "robot":
            self._arms[device] = _OpenedArm.of(identity.model)

    def look(self, seq: int, view: ReportedPose) -> None:
        """Add a viewpoint_captured event."""
        self._last[view.step, view.viewpoint, view.station] = seq
        why_not = next((arm.why_not for arm in self._arms.values() if arm.why_not), "")
        if why_not or not self._arms:
            self._unjudged[why_not or "the record names no arm that was connected before"] += 1
            return
        import numpy as np  # noqa: PLC0415 - which few verifications need

        from service.core.arms import fits, flange_pose, pose_gap  # noqa: PLC0415

        joints, pose = np.array(view.joints_rad, dtype=float), np.array(view.T_base_flange, dtype=float)
        arms = [arm.kinematics for arm in self._arms.values()]
        gaps = [pose_gap(flange_pose(a, joints), pose) for a in arms if a and a.axes == len(joints)]
        if not gaps:
            models = " and ".join(dict.fromkeys(arm.model for arm in self._arms.values()))
            self._unjudged[f"an arm {models} has not the {len(joints)} joints that were recorded"] += 1
        elif not any(map(fits, gaps)):
            self._away[seq] = AwayView(seq, view.viewpoint, *min(gaps))

    def not_judged(self) -> list[str]:
        """Return a sentence for each reason for which views are not judged, with their number."""
        return [
            f"pose and joints of {counted(number, 'view')}{NOT_COMPARED}{reason}"
            for reason, number in self._unjudged.items()
        ]

    def findings(self, run_id: str) -> tuple[list[AwayView], list[str]]:
        """Return views whose newest image has a wrong pose, and notes on those that were taken again since."""
        newest = set(self._last.values())
        faults = [away for seq, away in self._away.items() if seq in newest]
        return faults, list(self._notes(run_id, newest))

    def _notes(self, run_id: str, newest: set[int]) -> Iterator[str]:
        for seq, away in self._away.items():
            if seq not in newest:
                yield f"{run_id}, event {seq}: {away}. It was taken again since"


Rows = Sequence[Mapping[str, Any]]
_REF_COLUMNS = tuple(ArtefactRef.model_fields)
_CLOCK_READ_TWICE_S = 5.0
_BACK_S = 1.0  # less is a step of the time service
_OF_JOBS = frozenset({"job_enqueued", "job_finished", "job_failed"})
_SIGNED_AT_ONCE = frozenset({"step_passed", "run_completed", "run_aborted"})
# A runner records these only after it has signed; other processes may record other events at any moment.
_AFTER_A_SIGNATURE = frozenset({"step_started", "session_started", "run_completed", "run_aborted"})
_JOB_COLUMNS = {"job": "job_id", "job_kind": "kind", "step": "step", "attempt": "attempt"}


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault found by the verification."""

    run_id: str | None
    seq: int | None  # number of the event concerned
    file: str
    what: str  # the fault as text

    def __str__(self) -> str:
        place = ", ".join(
            part
            for part in (
                f"run {self.run_id}" if self.run_id else "",
                f"event {self.seq}" if self.seq is not None else "",
                self.file,
            )
            if part
        )
        return f"{place}: {self.what}" if place else self.what


@dataclass(frozen=True, slots=True)
class FileState:
    """The result of checking a recorded file again; `problem` is "" if it could be read.

    `how` says what was hashed: the file in this folder, what the object store sent, or nothing: its own statement, or
    the store is away, and nobody can say now what it holds.
    """

    shown: str
    sha256: str
    size: int
    problem: str
    how: Literal["here", "fetched", "stated", "away"] = "here"


@dataclass
class ChainFacts:
    """The facts of a chain that other checks need, collected in one pass over its events."""

    sha256_at: dict[int, str] = field(default_factory=dict[int, str])
    jobs: dict[int, Any] = field(default_factory=dict[int, Any])  # seq → payload about a job
    jobs_utc: dict[int, str] = field(default_factory=dict[int, str])  # seq → its time
    key_changes: list[tuple[int, Any]] = field(default_factory=list[tuple[int, Any]])
    people: list[tuple[Any, str]] = field(default_factory=list[tuple[Any, str]])  # account changes, sign-ins; times
    stamps: list[tuple[int, Any]] = field(default_factory=list[tuple[int, Any]])  # time_stamp_kept, of the site
    heads_at_start: list[tuple[int, Any]] = field(default_factory=list[tuple[int, Any]])  # heads in service_started
    runs_signed: list[tuple[int, Any]] = field(default_factory=list[tuple[int, Any]])  # run_signed, of the site
    written_again: list[tuple[int, SignaturesWrittenAgain]] = field(
        default_factory=list[tuple[int, SignaturesWrittenAgain]]
    )  # of the site
    to_sign: list[tuple[int, str]] = field(default_factory=list[tuple[int, str]])  # events that are signed at once
    last_own: int = 0  # seq of the last event that is not about a job
    to_sign_before: dict[int, int] = field(
        default_factory=dict[int, int]
    )  # of `to_sign`: seq → signed before this seq
    first: Mapping[str, Any] | None = None
    poses: PoseFacts = field(default_factory=PoseFacts)
    backwards: list[tuple[int, float]] = field(
        default_factory=list[tuple[int, float]]
    )  # seq, s before the one before
    _last_utc: str = ""

    def pass_time(self, seq: int, at_utc: str) -> None:
        """Look at the time of the next event, and keep where the host's clock ran backwards."""
        if at_utc < self._last_utc:  # ISO 8601 of one form sorts by time
            try:
                back_s = (datetime.fromisoformat(self._last_utc) - datetime.fromisoformat(at_utc)).total_seconds()
            except (ValueError, TypeError):
                back_s = 0.0  # no time at all, which its hash shows
            if back_s > _BACK_S:
                self.backwards.append((seq, back_s))
        self._last_utc = at_utc

    def backwards_notes(self, run_id: str) -> list[str]:
        """Return a note if times run backwards within the chain: the order of events is that of their numbers."""
        if not self.backwards:
            return []
        seq, back_s = self.backwards[0]
        more = len(self.backwards) - 1
        return [
            f"{run_id}: at event {seq} the time is {back_s:.0f} s before that of the event before"
            + (f", and so at {more} more" if more else "")
            + "; the host's clock was set back. The events are in the order of their numbers"
        ]

    def add(self, seq: int, payload: Any, at_utc: str) -> None:
        """Add an event whose content has verified."""
        kind = payload["kind"]
        if kind in _OF_JOBS:
            self.jobs[seq] = payload
            self.jobs_utc[seq] = at_utc
            return
        self.last_own = seq
        if kind in _AFTER_A_SIGNATURE and self.to_sign:
            self.to_sign_before.setdefault(self.to_sign[-1][0], seq)
        if kind in _SIGNED_AT_ONCE:
            self.to_sign.append((seq, kind))
        if kind == "viewpoint_captured":
            place = (payload["step"], payload["viewpoint"], payload["station"])
            self.poses.look(seq, ReportedPose(*place, payload["joints_rad"], payload["T_base_flange"]))
        elif kind == "device_opened":
            self.poses.open(payload["device"], payload["report"])
        elif kind == "key_changed":
            self.key_changes.append((seq, payload))
        elif kind == "account_changed" or (kind == "sign_in_recorded" and payload["screen"]):
            self.people.append((payload, at_utc))
        elif kind == "time_stamp_kept":
            self.stamps.append((seq, payload))
        elif kind == "run_signed":
            self.runs_signed.append((seq, payload))
        elif kind == "signatures_written_again":
            self.written_again.append((seq, SignaturesWrittenAgain.model_validate(payload)))
        elif kind == "service_started":
            self.heads_at_start.append((seq, payload["heads"]))


@dataclass(frozen=True, slots=True)
class ChainRows:
    """The rows of one run, or of the site, in the order of the events."""

    runs: Rows
    heads: Rows
    events: Iterable[Mapping[Any, Any]]
    artefacts: Rows
    jobs: Rows


def run_faults(
    run_id: str, rows: ChainRows, files: Mapping[str, FileState] | None, facts: ChainFacts
) -> Iterator[Fault]:
    """Yield every fault of one run: first by event, then of the run as a whole.

    Fills `facts`; `files` None: not read.
    """
    by_seq: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows.artefacts:
        by_seq.setdefault(int(row["seq"]), []).append(row)
    recorded: set[tuple[str, int]] = set()
    seq, previous = 0, ROOT
    for row in rows.events:
        yield from _link_faults(run_id, row, seq, previous)
        seq, previous = int(row["seq"]), str(row["sha256"])
        facts.sha256_at[seq] = previous
        facts.first = facts.first or row
        mine = by_seq.pop(seq, [])
        payload, named, problem = _payload_of(row)
        if problem:
            yield Fault(run_id, seq, "", problem)
            continue
        facts.pass_time(seq, str(row["at_utc"]))
        facts.add(seq, payload, str(row["at_utc"]))
        recorded |= {(str(item["sha256"]), int(item["size_bytes"])) for item in mine}
        yield from _artefact_faults(run_id, row, payload, named, mine, recorded=recorded, files=files)
    for left in by_seq.values():
        for item in left:
            what = f"artefact {item['original_name']} ({item['sha256']}) belongs to an event that is not there"
            yield Fault(run_id, int(item["seq"]), "", what)
    yield from _end_faults(run_id, rows.runs, rows.heads, facts.first, (seq, previous))
    yield from _job_faults(run_id, rows.jobs, facts.jobs, facts.jobs_utc)


def chain_fault(
    run_id: str, event_rows: Iterable[Mapping[Any, Any]], end: tuple[int, str]
) -> Fault | tuple[int, str]:
    """Return the first fault in the events that follow `end` (seq, sha256), or the new end of the chain."""
    seq, previous = end
    for row in event_rows:
        for fault in _link_faults(run_id, row, seq, previous):
            return fault
        seq, previous = int(row["seq"]), str(row["sha256"])
        _, _, problem = _payload_of(row)
        if problem:
            return Fault(run_id, seq, "", problem)
    return seq, previous


def _link_faults(run_id: str, row: Mapping[str, Any], before: int, previous: str) -> Iterator[Fault]:
    seq = int(row["seq"])
    if seq != before + 1:
        missing = f"event {before + 1} is" if seq == before + 2 else f"events {before + 1} to {seq - 1} are"
        yield Fault(run_id, before + 1, "", f"{missing} missing from the chain")
    elif row["previous_sha256"] != previous:
        yield Fault(run_id, seq, "", f"previous_sha256 is {row['previous_sha256']}, the event before has {previous}")


def _payload_of(row: Mapping[str, Any]) -> tuple[Any, tuple[ArtefactRef, ...], str]:
    """Return (payload as plain data, references, "") of a valid event, (None, (), problem) of an invalid one."""
    try:
        payload = parse_canonical(row["payload"])
        PAYLOAD.validate_python(payload)
        text = canonical_parsed(payload)
        fields = {name: row[name] for name in ("seq", "run_id", "at_utc", "monotonic_s", "actor", "previous_sha256")}
        digest = event_sha256_of_text(fields, text)
        if digest != row["sha256"]:
            return None, (), f"the content was altered: its SHA-256 is {digest}, recorded is {row['sha256']}"
        if text != row["payload"]:
            return None, (), "the payload is not in canonical form: its text was altered"
        if payload["kind"] != row["kind"]:
            return None, (), f"the column kind says {row['kind']}, the payload {payload['kind']}"
        # Searching every payload for references is slow; in canonical form a reference always contains this text.
        named = references(payload) if '"original_name":' in text else ()
    except (ValidationError, ValueError, StoreError) as error:
        return None, (), f"the content was altered: it cannot be read ({str(error).splitlines()[0]})"
    return payload, named, ""


def _artefact_faults(
    run_id: str,
    event: Mapping[str, Any],
    payload: Any,
    named: tuple[ArtefactRef, ...],
    rows: Rows,
    *,
    recorded: set[tuple[str, int]],
    files: Mapping[str, FileState] | None,
) -> Iterator[Fault]:
    seq = int(event["seq"])
    for row in rows:
        state = None if files is None else files[row["sha256"]]
        shown = "" if state is None else state.shown
        if ArtefactRef(**{column: row[column] for column in _REF_COLUMNS}) not in named:
            yield Fault(run_id, seq, shown, "the artefact's row is not what the event refers to")
        elif record_sha256(event["sha256"], dict(row)) != row["record_sha256"]:
            yield Fault(run_id, seq, shown, "the artefact's row was altered (device, step, time, who …)")
        if state is None or state.how == "away":
            continue
        if state.problem:
            yield Fault(run_id, seq, state.shown, f"{state.problem} ({row['original_name']})")
        elif state.size != row["size_bytes"]:
            what = f"the file has {state.size} bytes, recorded are {row['size_bytes']} ({row['original_name']})"
            yield Fault(run_id, seq, state.shown, what)
        elif state.sha256 != row["sha256"]:
            yield Fault(run_id, seq, state.shown, f"the content was altered: its SHA-256 is {state.sha256}")
    for ref in named:
        if (ref.sha256, ref.size_bytes) not in recorded:
            what = f"{payload['kind']} refers to {ref.original_name} ({ref.sha256}), which has no artefact row"
            yield Fault(run_id, seq, "", what)


def _end_faults(
    run_id: str, run_rows: Rows, head_rows: Rows, first: Mapping[str, Any] | None, end: tuple[int, str]
) -> Iterator[Fault]:
    for head in head_rows:
        if (head["seq"], head["sha256"]) != end:
            what = (
                f"the chain ends at event {end[0]} ({end[1]}), it was left at event {head['seq']} ({head['sha256']})"
            )
            yield Fault(run_id, end[0] + 1, "", what)
    if not head_rows:
        yield Fault(run_id, None, "", "the record of where the chain ends is missing")
    if not run_rows:
        yield Fault(run_id, None, "", "the run's own row is missing")
    for row in run_rows:
        kind = "site_opened" if run_id == SITE else "run_started"
        if first is None or first["sha256"] != row["root_sha256"] or first["kind"] != kind:
            yield Fault(run_id, 1, "", f"the chain does not begin with the {kind} that the run's row names")
        elif _payload_of(first)[0] is not None and parse_canonical(first["payload"]).get("simulated", False) != bool(
            row["simulated"]
        ):
            yield Fault(run_id, 1, "", "the run's row and its first event disagree on whether it was simulated")
        if first is not None and not _same_moment(str(row["created_utc"]), str(first["at_utc"])):
            what = f"the run's row says that it was made at {row['created_utc']}, its first event {first['at_utc']}"
            yield Fault(run_id, 1, "", what)


def _same_moment(one_utc: str, other_utc: str) -> bool:
    """Return whether two times agree to a few seconds; older versions read the clock twice."""
    try:
        apart = datetime.fromisoformat(one_utc) - datetime.fromisoformat(other_utc)
    except (ValueError, TypeError):
        return False
    return abs(apart.total_seconds()) < _CLOCK_READ_TWICE_S


def _job_faults(run_id: str, rows: Rows, payloads: Mapping[int, Any], at_utc: Mapping[int, str]) -> Iterator[Fault]:
    enqueued = {seq: payload for seq, payload in payloads.items() if payload["kind"] == "job_enqueued"}
    ended = {seq: payload for seq, payload in payloads.items() if payload["kind"] in ("job_finished", "job_failed")}
    ends_of: dict[str, dict[int, Any]] = {}
    for seq, end in ended.items():
        ends_of.setdefault(end["job"], {})[seq] = end
    for row in rows:
        shown = f"job {row['job_id']}"
        payload = enqueued.pop(int(row["enqueued_seq"]), None)
        if payload is None:
            yield Fault(run_id, int(row["enqueued_seq"]), "", f"{shown} has no event job_enqueued")
        elif (
            any(payload[name] != row[column] for name, column in _JOB_COLUMNS.items())
            or payload["idempotency_key"] != row["idempotency_key"]
            or canonical_parsed(payload["arguments"]) != row["arguments"]
            or payload.get("priority", row["priority"]) != row["priority"]
            or at_utc.get(int(row["enqueued_seq"])) != row["enqueued_utc"]
        ):
            yield Fault(run_id, int(row["enqueued_seq"]), "", f"{shown} differs from its event job_enqueued")
        ends = ends_of.pop(row["job_id"], {})
        expected = {"finished": "job_finished", "failed": "job_failed"}.get(str(row["state"]))
        found = {seq: end["kind"] for seq, end in ends.items()}
        if found != ({} if expected is None else {row["ended_seq"]: expected}):
            what = f"{shown} is {row['state']}, but its ending events are {found or 'none'}"
            yield Fault(run_id, row["ended_seq"], "", what)
        elif expected is not None:
            yield from _end_of_job_faults(run_id, row, ends[row["ended_seq"]], at_utc)
        elif row["ended_seq"] is not None or row["ended_utc"] is not None:
            yield Fault(run_id, int(row["enqueued_seq"]), "", f"{shown} is {row['state']} and has an end")
    for seq, payload in enqueued.items():
        yield Fault(run_id, seq, "", f"job {payload['job']} was enqueued and has no row")
    for seq, payload in ((seq, end) for ends in ends_of.values() for seq, end in ends.items()):
        yield Fault(run_id, seq, "", f"job {payload['job']} ended and has no row")


def _end_of_job_faults(
    run_id: str, row: Mapping[str, Any], end: Mapping[str, Any], at_utc: Mapping[int, str]
) -> Iterator[Fault]:
    error = f"{end['error']}: {end['message']}" if end["kind"] == "job_failed" else None
    lease = row["token"], row["until_utc_s"]
    told = error, at_utc.get(row["ended_seq"]), end["worker"], (None, None)
    if (row["error"], row["ended_utc"], row["worker"] or "", lease) != told:
        yield Fault(run_id, row["ended_seq"], "", f"job {row['job_id']} differs from its event {end['kind']}")


def summary(payload: Mapping[str, Any]) -> str:
    """Return one line on an event's payload: its scalar fields in order, long ones cut."""
    parts = [
        f"{name}={value}"
        for name, value in payload.items()
        if name != "kind"
        and isinstance(value, str | int | float | bool)
        and value not in ("", False)
        and name != "why"
    ]
    text = " ".join(part if len(part) <= 60 else part[:59] + "…" for part in parts)
    return text if len(text) <= 160 else text[:159] + "…"
