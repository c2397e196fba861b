"""The first page of an audit: every deviation in plain words, counted and listed; and the list of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from service.audit.background import PartialProgress
from service.audit.filters import RunFilter
from service.audit.overview.digest import Digest, FailedGate
from service.audit.record.rows import RunBasics
from service.audit.verify.verifications import Verification
from service.core.gates import describe_judged
from service.core.run.state import DeviationKind

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
