"""The results of a replay: every job, file and gate as it was recorded and as it came out again."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from service.audit.replay.differences import Comparison, Difference
from service.audit.replay.recomputed import Drift
from service.core.records.events import GateVerdict

Verdict = Literal["identical", "within_tolerance", "different", "not_replayed"]
_WORST_FIRST: tuple[Verdict, ...] = ("not_replayed", "different", "within_tolerance")


@dataclass(frozen=True, slots=True)
class VersionChange:
    """A distribution that is not what it was when the run was recorded; "" where it is or was not installed."""

    name: str
    recorded: str
    now: str


@dataclass(frozen=True, slots=True)
class ArtefactReplay:
    """A file that a job wrote, and the same file written again."""

    name: str
    kind: str
    recorded_sha256: str
    recomputed_sha256: str
    content: Comparison  # empty where the hashes are the same


@dataclass(frozen=True, slots=True)
class JobReplay:
    """One job computed again."""

    job: str
    kind: str
    step: str
    attempt: int
    label: str  # the source of poses, which distinguishes registrations; "" for other kinds
    verdict: Verdict
    measures: Comparison = field(default_factory=Comparison)
    result: Comparison = field(default_factory=Comparison)
    artefacts: tuple[ArtefactReplay, ...] = ()
    duration_s: float = 0.0
    error: str = ""  # why it could not be replayed
    computed_by: str = ""  # the version that computed it, in words, if this program's gives other numbers

    @property
    def differences(self) -> tuple[Difference, ...]:
        """Of measures, result and files, in this order, each worst first."""
        parts = (self.measures, self.result, *(artefact.content for artefact in self.artefacts))
        return tuple(difference for part in parts for difference in part.differences)


@dataclass(frozen=True, slots=True)
class GateReplay:
    """A step's gates judged again by the measures that the replay gave."""

    step: str
    attempt: int
    recorded: tuple[GateVerdict, ...]
    recomputed: tuple[GateVerdict, ...]

    @property
    def changed(self) -> tuple[tuple[GateVerdict, GateVerdict], ...]:
        """Verdicts that are now different: recorded, recomputed."""
        pairs = zip(self.recorded, self.recomputed, strict=True)
        return tuple((old, new) for old, new in pairs if old.passed != new.passed)


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """The whole replay. `gates_judged`: number of recorded verdicts that follow from the recorded measures."""

    run_id: str
    head_sha256: str
    end_to_end: bool
    versions: tuple[VersionChange, ...]
    files_verified: int
    bytes_verified: int
    gates_judged: int
    gates: tuple[GateReplay, ...]
    jobs: tuple[JobReplay, ...]
    drifts: tuple[Drift, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst of all jobs; a gate with another verdict is a difference."""
        found: set[Verdict] = {job.verdict for job in self.jobs}
        if any(gate.changed for gate in self.gates):
            found.add("different")
        for verdict in _WORST_FIRST:
            if verdict in found:
                return verdict
        return "identical"
