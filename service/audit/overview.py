"""A run's digest, folded in the background: its photographs, deviations and gates, and the list of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

from pydantic import TypeAdapter
from pydantic_core import from_json
from sqlalchemy import Connection, text

from service.audit.background import IncrementalResults, PartialProgress, PartialResult
from service.audit.filters import RunFilter
from service.audit.queries import Facets, RunBasics, head, plain, root
from service.audit.verifications import Verification
from service.computations import evaluate
from service.core.errors import IntegrityError, OrthocaptureError
from service.core.gates import describe_judged
from service.core.protocol import Protocol, parse_protocol
from service.core.records.events import PAYLOAD, Event, Payload
from service.core.records.run_events import GatesEvaluated, GateVerdict, RecordedView, ViewpointFailed
from service.core.run.fold import DECISIVE_EVENTS, RUN_EVENTS, advance, initial_state
from service.core.run.state import Deviation, DeviationKind, RunState
from service.core.words import counted
from service.dataset.registrations import LateResult, late_results
from service.store.store import Store

# --- the digest of a run, folded in the background from the few kinds of events that matter -----------------------

CHUNK = 300  # events in one step, after which waiting pages come first

# Only these computations change the first page: results that arrived after the evaluation.
_JOB_EVENTS = ("job_enqueued", "job_finished")
_JOB_KINDS = (evaluate.KIND.name,)

# The fold needs only step, attempt and viewpoint of these events.
_VIEWS = {kind: payload for kind, payload in RUN_EVENTS.items() if issubclass(payload, RecordedView)}
_SHORTENED = ("step_measured", "job_finished", "job_enqueued")


@dataclass(frozen=True, slots=True)
class _Place:
    """The view that an event is about."""

    step: str
    attempt: int
    viewpoint: str


_PLACE = TypeAdapter(_Place)


@dataclass(frozen=True, slots=True)
class FailedGate:
    """A gate that did not pass, because its figure is outside the limits or not decided."""

    seq: int
    at_utc: str
    step: str
    attempt: int
    verdict: GateVerdict


@dataclass
class Digest:
    """The state of a run after the event `seq`."""

    run_id: str
    seq: int = 0
    protocol: Protocol | None = None
    state: RunState | None = None  # None if the protocol cannot be read
    failed_gates: list[FailedGate] = field(default_factory=list[FailedGate])
    times: dict[int, str] = field(default_factory=dict[int, str])  # times of deviations and automatic confirmations
    facets: Facets = field(default_factory=Facets)
    problem: str = ""  # why the fold stopped before the end of the chain; "" if it did not

    def copy(self) -> Digest:
        """Return a copy that can be continued while pages read this one."""
        return replace(self, failed_gates=list(self.failed_gates), times=dict(self.times), facets=self.facets.copy())

    @property
    def deviations(self) -> Sequence[Deviation]:
        """All deviations in order."""
        return self.state.deviations if self.state else ()

    @property
    def automatic(self) -> Sequence[Deviation]:
        """The automatic confirmations in order."""
        return self.state.automatic if self.state else ()

    @property
    def late(self) -> list[LateResult]:
        """Results that arrived after the evaluation."""
        return late_results(self.protocol, self.state) if self.protocol and self.state else []

    @property
    def status(self) -> str:
        """active, paused, completed or aborted; unknown if the events contradict each other."""
        return self.state.status if self.state and not self.problem else "unknown"

    @property
    def people(self) -> list[str]:
        """The people who took part, in alphabetical order."""
        return sorted(self.state.people) if self.state else []

    @property
    def unsigned(self) -> list[tuple[str, str]]:
        """Steps that need a signature and have none, each with its phase."""
        if self.protocol is None or self.state is None:
            return []
        steps = [(step.id, self.state.steps[step.id]) for step in self.protocol.steps if step.sign]
        return [(name, "skipped" if s.skipped else s.phase) for name, s in steps if not s.signed]


def digests(store: Store) -> IncrementalResults[Digest]:
    """Return digests of a data folder's runs, updated in the background."""
    return IncrementalResults(store, lambda run_id, before: step(store, run_id, before), "digest")


def step(store: Store, run_id: str, before: Digest | None) -> PartialResult[Digest]:
    """Continue a digest by one chunk of events. Raises UnknownRunError, StoreError."""
    digest = before or Digest(run_id)
    with store.database.reading() as connection:
        last, sha256 = head(connection, run_id)
        if before is None:
            _begin(digest, store, connection)
        upto = _chunk_end(connection, run_id, digest.seq, last)
        rows = [] if digest.problem else _rows(connection, run_id, digest.seq, upto)
        digest.facets.add(connection, run_id, digest.seq, upto)
    for row in rows:
        if not digest.problem:
            _advance(digest, row)
    digest.seq = upto
    return PartialResult(digest, upto, last, sha256)


def _begin(digest: Digest, store: Store, connection: Connection) -> None:
    # Imported here because loading every step kind takes a second.
    from service.steps import params_models  # noqa: PLC0415

    try:
        started = root(connection, digest.run_id)
        content = store.artefact_path(started.protocol.sha256, verify=True).read_bytes()
        loaded = parse_protocol(content, params_models(), name=started.protocol.original_name)
    except (OrthocaptureError, OSError) as error:
        digest.problem = f"The protocol of this run cannot be read: {error}"
        return
    digest.protocol = loaded.protocol
    digest.state = initial_state(loaded.protocol)


def _chunk_end(connection: Connection, run_id: str, after: int, last: int) -> int:
    """Return the last event of the next chunk. The chunk's size counts only events that the digest reads."""
    found = connection.execute(
        text(
            "SELECT seq FROM event_index WHERE run_id = :run AND seq > :after "
            f"AND kind IN ({_quoted(DECISIVE_EVENTS)}) ORDER BY seq LIMIT 1 OFFSET :chunk"
        ),
        {"run": run_id, "after": after, "chunk": CHUNK - 1},
    ).scalar_one_or_none()
    return last if found is None else int(found)


def _quoted(kinds: Sequence[str]) -> str:
    return ", ".join(f"'{kind}'" for kind in kinds)


def _rows(connection: Connection, run_id: str, after: int, upto: int) -> Sequence[Any]:
    return connection.execute(
        text(
            "SELECT seq, kind, at_utc, monotonic_s, actor, payload, previous_sha256, sha256 FROM events AS e "
            f"WHERE run_id = :run AND seq > :after AND seq <= :upto AND (kind IN ({_quoted(DECISIVE_EVENTS)}) "
            f"OR kind IN ({_quoted(_JOB_EVENTS)}) AND EXISTS (SELECT 1 FROM event_facets AS f "
            "WHERE f.run_id = e.run_id AND f.seq = e.seq AND f.name = 'job_kind' "
            f"AND f.value IN ({_quoted(_JOB_KINDS)}))) ORDER BY seq"
        ),
        {"run": run_id, "after": after, "upto": upto},
    ).all()


def _advance(digest: Digest, row: Any) -> None:
    assert digest.protocol is not None  # _begin has set a problem otherwise
    assert digest.state is not None
    try:
        payload = _payload(row.kind, row.payload)
    except ValueError as error:
        digest.problem = f"Event {row.seq} cannot be read: {str(error).splitlines()[0]}"
        return
    event = Event.model_construct(
        seq=row.seq,
        run_id=digest.run_id,
        at_utc=row.at_utc,
        monotonic_s=row.monotonic_s,
        actor=row.actor,
        payload=payload,
        previous_sha256=row.previous_sha256,
        sha256=row.sha256,
    )
    known = len(digest.state.deviations) + len(digest.state.automatic)
    try:
        digest.state = advance(digest.protocol, replace(digest.state, seq=row.seq - 1), event)
    except IntegrityError as error:
        digest.problem = str(error)
        return
    if len(digest.state.deviations) + len(digest.state.automatic) > known:
        digest.times[row.seq] = row.at_utc
    if isinstance(payload, GatesEvaluated) and not payload.passed:
        digest.failed_gates += [
            FailedGate(row.seq, row.at_utc, payload.step, payload.attempt, verdict)
            for verdict in payload.verdicts
            if not verdict.passed
        ]


def _payload(kind: str, content: str) -> Payload:
    """Return the payload of an event without the parts that no digest needs, which may be large."""
    if kind in _VIEWS:
        place = _PLACE.validate_json(content)
        view = _VIEWS[kind].model_construct(step=place.step, attempt=place.attempt, viewpoint=place.viewpoint)
        return cast("Payload", view)
    if kind not in _SHORTENED:
        return PAYLOAD.validate_json(content)
    fields: dict[str, Any] = from_json(content)
    if kind == "job_enqueued":
        fields["arguments"] = {}
    else:  # of a result, only the evaluation's table is needed; its files are not
        fields.pop("artefacts", None)
        result = fields.get("result")
        table: object = result.get("table") if isinstance(result, Mapping) else None
        fields["result"] = {"table": table} if isinstance(table, list) else {}
    return PAYLOAD.validate_python(fields)


@dataclass(frozen=True, slots=True)
class Shots:
    """Photographs of a step or of a run. Replaced ones stay in the evidence and are verified like the rest."""

    step: str
    title: str
    count: int  # photographs that count
    replaced: int  # retaken since, or of a repeated attempt
    failed: int  # exposures that failed and gave no file
    given_up: int  # views that were skipped

    @property
    def taken(self) -> int:
        """Photographs that were taken and recorded."""
        return self.count + self.replaced

    @property
    def words(self) -> str:
        """`57 photographs taken: 54 in use, 3 replaced by later ones; 2 exposures failed`."""
        if not self.taken and not self.failed:
            return "no photograph taken"
        parts = [f"{self.count} in use"]
        if self.replaced:
            parts.append(f"{self.replaced} replaced by later ones")
        told = f"{counted(self.taken, 'photograph')} taken: {', '.join(parts)}"
        return told + (f"; {counted(self.failed, 'exposure')} failed" if self.failed else "")


def shots_by_step(protocol: Protocol, state: RunState, failures: Mapping[str, int]) -> list[Shots]:
    """Return the photographs of each step that took any or tried to; `failures`: failed exposures by step."""
    found: list[Shots] = []
    for step in protocol.steps:
        now = state.steps[step.id]
        counting = set(now.captured.values())
        past = {seq for one in state.superseded if one.step == step.id for seq in one.captured.values()} - counting
        shots = Shots(
            step.id, step.title, len(counting), len(past), failures.get(step.id, 0), len(now.skipped_viewpoints)
        )
        if shots.taken or shots.failed or shots.given_up:
            found.append(shots)
    return found


def shots_of(digest: Digest | None, failures: Mapping[str, int]) -> list[Shots]:
    """Return `shots_by_step` of a digest; empty while there is none."""
    if digest is None or digest.protocol is None or digest.state is None:
        return []
    return shots_by_step(digest.protocol, digest.state, failures)


def together(shots: Sequence[Shots]) -> Shots:
    """Return the photographs of all steps together."""
    return Shots(
        "",
        "Together",
        sum(one.count for one in shots),
        sum(one.replaced for one in shots),
        sum(one.failed for one in shots),
        sum(one.given_up for one in shots),
    )


def failed_exposures(events: Sequence[Event]) -> dict[str, int]:
    """Return the number of failed exposures of each step."""
    found: dict[str, int] = {}
    for event in events:
        if isinstance(event.payload, ViewpointFailed):
            found[event.payload.step] = found.get(event.payload.step, 0) + 1
    return found


def failed_exposures_of(connection: Connection, run_id: str) -> dict[str, int]:
    """Return the number of failed exposures of each step, counted in the database without reading the events."""
    rows = connection.execute(
        text(
            "SELECT step, count(*) AS n FROM event_index "
            "WHERE run_id = :run AND kind = 'viewpoint_failed' GROUP BY step"
        ),
        {"run": plain(run_id)},
    ).all()
    return {str(row.step): int(row.n) for row in rows}


# --- the deviations of a run in plain words, and the list of runs -------------------------------------------------

# Group on the page → its name in the plural, and the kinds of deviations in it; a group without any lists none.
GROUPS: Mapping[str, tuple[str, frozenset[DeviationKind]]] = {
    "accepted": ("Gates accepted", frozenset({"gate_accepted"})),
    "redone": ("Re-dos", frozenset({"redo", "redo_viewpoint", "reset_by_redo"})),
    "skipped_views": ("Skipped views", frozenset({"viewpoint_skipped"})),
    "skipped_steps": ("Skipped steps", frozenset({"skip"})),
    "overridden": ("Gates overridden", frozenset({"gate_overridden"})),
    "refused": ("Refused actions", frozenset({"refused"})),
    "failed_gates": ("Failed gates", frozenset()),
    "undecided_gates": ("Gates not decided", frozenset()),
    "late_results": ("Results that arrived later", frozenset()),
    "automatic": ("Automatic confirmations", frozenset({"automatic"})),
}
# Group → its name in the singular.
_OF_ONE: Mapping[str, str] = {
    "accepted": "Gate accepted",
    "redone": "Re-do",
    "skipped_views": "Skipped view",
    "skipped_steps": "Skipped step",
    "overridden": "Gate overridden",
    "refused": "Refused action",
    "failed_gates": "Failed gate",
    "undecided_gates": "Gate not decided",
    "late_results": "Result that arrived later",
    "automatic": "Automatic confirmation",
}


DEVIATION_GROUPS = tuple(group for group, (_, kinds) in GROUPS.items() if kinds and "automatic" not in kinds)
NOTE_GROUPS = tuple(group for group in GROUPS if group not in DEVIATION_GROUPS)  # recorded, and no deviations


def group_name(group: str, number: int) -> str:
    """Return the name of a group for this number of findings."""
    return _OF_ONE[group] if number == 1 else GROUPS[group][0]


_NAMES: Mapping[str, str] = {
    "skip": "Step skipped",
    "gate_accepted": "Gate accepted outside its limits",
    "gate_overridden": "Gate overridden",
    "redo": "Step done again",
    "redo_viewpoint": "View taken again",
    "reset_by_redo": "Reset by a re-do",
    "viewpoint_skipped": "View skipped",
    "refused": "Refused",
    "automatic": "Automatic",
    "late_result": "Result arrived later",
    "failed_gate": "Gate failed",
    "undecided_gate": "Gate not decided",
}


def kind_name(kind: str) -> str:
    """Return what a kind of finding is called, in the audit and on the pages of the run."""
    return _NAMES[kind]


@dataclass(frozen=True, slots=True)
class Finding:
    """A line in the list of deviations, or of what else is recorded."""

    seq: int
    at_utc: str
    kind: str
    step: str
    person: str
    text: str

    @property
    def name(self) -> str:
        """The label of its kind."""
        return kind_name(self.kind)


def findings(digest: Digest, group: str = "") -> list[Finding]:
    """Return a run's deviations, accepted gates first; with `group`, what is in this group, deviations or not."""
    kinds = GROUPS[group][1] if group in GROUPS else None
    listed = digest.automatic if group == "automatic" else digest.deviations
    found = [
        Finding(d.seq, digest.times.get(d.seq, ""), d.kind, d.step or "", d.actor, d.text)
        for d in listed
        if kinds is None or d.kind in kinds
    ]
    found += [_of_gate(gate) for gate in digest.failed_gates if _GATE_GROUPS[_gate_kind(gate)] == group]
    if group == "late_results":
        found += [Finding(late.seq, late.at_utc, "late_result", late.step, "", late.text) for late in digest.late]
    return sorted(found, key=lambda finding: (finding.kind != "gate_accepted", finding.seq))


def failed_gates(digest: Digest) -> list[Finding]:
    """Return the gates that did not pass in some attempt, in order: no deviations, but what readers ask for next."""
    return sorted(map(_of_gate, digest.failed_gates), key=lambda finding: finding.seq)


_GATE_GROUPS = {"failed_gate": "failed_gates", "undecided_gate": "undecided_gates"}


def _gate_kind(gate: FailedGate) -> str:
    return "undecided_gate" if gate.verdict.undecided else "failed_gate"


def _of_gate(gate: FailedGate) -> Finding:
    text = f"{describe_judged(gate.verdict)} (attempt {gate.attempt})"
    return Finding(gate.seq, gate.at_utc, _gate_kind(gate), gate.step, "", text)


def counts(digest: Digest) -> dict[str, int]:
    """Return the number of findings in each group."""
    by_kind: dict[str, int] = {}
    for deviation in (*digest.deviations, *digest.automatic):
        by_kind[deviation.kind] = by_kind.get(deviation.kind, 0) + 1
    found = {group: sum(by_kind.get(kind, 0) for kind in kinds) for group, (_, kinds) in GROUPS.items()}
    kinds_of_gates = [_gate_kind(gate) for gate in digest.failed_gates]
    of_gates = {group: kinds_of_gates.count(kind) for kind, group in _GATE_GROUPS.items()}
    return found | of_gates | {"late_results": len(digest.late)}


# --- the list of runs -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ListedRun:
    """A row in the list of runs."""

    basics: RunBasics
    digest: Digest | None  # None: being computed
    verification: Verification | None

    @property
    def status(self) -> str:
        """The status in the digest; "" while the digest is being computed."""
        return self.digest.status if self.digest else ""

    @property
    def deviations(self) -> int | None:
        """The number of deviations."""
        if self.digest is None or self.digest.state is None:
            return None
        return len(self.digest.deviations)

    @property
    def verified(self) -> str:
        """The state of the newest verification, as `verified` words it."""
        return verified(self.verification, self.basics.head_sha256)


def verified(verification: Verification | None, head_sha256: str) -> str:
    """Return the state of a verification: "never", "faults", "outdated", "partial" or "current".

    It is outdated if there are newer events, and partial if its anchors in the object store could not be read.
    """
    if verification is None:
        return "never"
    if not verification.ok:
        return "faults"
    if verification.head_sha256 != head_sha256:
        return "outdated"
    return "partial" if verification.not_compared else "current"


def matches(run: ListedRun, wanted: RunFilter) -> bool:
    """Return whether a run matches the filter, leaving aside its search words (see `find_runs`).

    A run whose digest is not known yet is not hidden.
    """
    basics, digest = run.basics, run.digest
    day = basics.created_utc[:10]
    fits = (
        (not wanted.since or wanted.since <= day)
        and (not wanted.until or day <= wanted.until)
        and wanted.protocol in ("", basics.protocol)
        and (not wanted.simulated or basics.simulated == (wanted.simulated == "yes"))
        and not (wanted.unverified and run.verified == "current")
    )
    if digest is None or not fits:
        return fits
    return (
        wanted.person in ("", basics.operator, *digest.people)
        and wanted.status in ("", run.status)
        and not (wanted.deviations and run.deviations == 0)
    )


def known(value: Digest | PartialProgress) -> Digest | None:
    """Return the digest, or None while it is being computed."""
    return None if isinstance(value, PartialProgress) else value


def people_of(runs: Sequence[ListedRun]) -> list[str]:
    """Return everybody who took part in any of these runs."""
    return sorted(
        {name for run in runs for name in (run.basics.operator, *(run.digest.people if run.digest else ()))}
    )
