"""How many photographs each step took: those that count, those taken again, and exposures that failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.audit.overview.digest import Digest
from service.audit.record.queries import plain
from service.core.protocol.models import Protocol
from service.core.records.events import Event, ViewpointFailed
from service.core.run.state import RunState
from service.core.text.counts import counted


@dataclass(frozen=True, slots=True)
class Shots:
    """Of one step, or of a whole run. What was replaced stays in the evidence and is verified like the rest."""

    step: str
    title: str
    count: int  # photographs that count
    replaced: int  # taken again since, or of an attempt that was done again
    failed: int  # exposures that failed and were tried again or given up: no file came of them
    given_up: int  # views that the step went on without

    @property
    def taken(self) -> int:
        """Photographs that were taken and recorded."""
        return self.count + self.replaced

    @property
    def words(self) -> str:
        """`57 photographs taken: 54 count, 3 were replaced by later ones; 2 exposures failed`."""
        if not self.taken and not self.failed:
            return "no photograph taken"
        parts = [f"{self.count} count" if self.count != 1 else "1 counts"]
        if self.replaced:
            parts.append(f"{self.replaced} {'was' if self.replaced == 1 else 'were'} replaced by later ones")
        told = f"{counted(self.taken, 'photograph')} taken: {', '.join(parts)}"
        return told + (f"; {counted(self.failed, 'exposure')} failed" if self.failed else "")


def shots_by_step(protocol: Protocol, state: RunState, failures: Mapping[str, int]) -> list[Shots]:
    """The steps that took photographs or tried to. `failures`: exposures that failed, by step."""
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
    """The same of a digest; empty while there is none."""
    if digest is None or digest.protocol is None or digest.state is None:
        return []
    return shots_by_step(digest.protocol, digest.state, failures)


def together(shots: Sequence[Shots]) -> Shots:
    """Of the whole run."""
    return Shots(
        "",
        "Together",
        sum(one.count for one in shots),
        sum(one.replaced for one in shots),
        sum(one.failed for one in shots),
        sum(one.given_up for one in shots),
    )


def failed_exposures(events: Sequence[Event]) -> dict[str, int]:
    """How many exposures of each step failed."""
    found: dict[str, int] = {}
    for event in events:
        if isinstance(event.payload, ViewpointFailed):
            found[event.payload.step] = found.get(event.payload.step, 0) + 1
    return found


def failed_exposures_of(connection: Connection, run_id: str) -> dict[str, int]:
    """The same from the database, without its events being read."""
    rows = connection.execute(
        text(
            "SELECT step, count(*) AS n FROM event_index "
            "WHERE run_id = :run AND kind = 'viewpoint_failed' GROUP BY step"
        ),
        {"run": plain(run_id)},
    ).all()
    return {str(row.step): int(row.n) for row in rows}
