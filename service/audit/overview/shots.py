"""The number of photographs of each step: those that count, replaced ones, and failed exposures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.audit.overview.digest import Digest
from service.audit.record.run_rows import plain
from service.core.protocol.models import Protocol
from service.core.records.events import Event, ViewpointFailed
from service.core.run.state import RunState
from service.core.text.words import counted


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
        """`57 photographs taken: 54 count, 3 were replaced by later ones; 2 exposures failed`."""
        if not self.taken and not self.failed:
            return "no photograph taken"
        parts = [f"{self.count} count" if self.count != 1 else "1 counts"]
        if self.replaced:
            parts.append(f"{self.replaced} {'was' if self.replaced == 1 else 'were'} replaced by later ones")
        told = f"{counted(self.taken, 'photograph')} taken: {', '.join(parts)}"
        return told + (f"; {counted(self.failed, 'exposure')} failed" if self.failed else "")


def shots_by_step(protocol: Protocol, state: RunState, failures: Mapping[str, int]) -> list[Shots]:
    """The photographs of each step that took any or tried to. `failures`: number of failed exposures by step."""
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
    """`shots_by_step` of a digest; empty while there is none."""
    if digest is None or digest.protocol is None or digest.state is None:
        return []
    return shots_by_step(digest.protocol, digest.state, failures)


def together(shots: Sequence[Shots]) -> Shots:
    """The photographs of all steps together."""
    return Shots(
        "",
        "Together",
        sum(one.count for one in shots),
        sum(one.replaced for one in shots),
        sum(one.failed for one in shots),
        sum(one.given_up for one in shots),
    )


def failed_exposures(events: Sequence[Event]) -> dict[str, int]:
    """The number of failed exposures of each step."""
    found: dict[str, int] = {}
    for event in events:
        if isinstance(event.payload, ViewpointFailed):
            found[event.payload.step] = found.get(event.payload.step, 0) + 1
    return found


def failed_exposures_of(connection: Connection, run_id: str) -> dict[str, int]:
    """The number of failed exposures of each step, counted in the database without reading the events."""
    rows = connection.execute(
        text(
            "SELECT step, count(*) AS n FROM event_index "
            "WHERE run_id = :run AND kind = 'viewpoint_failed' GROUP BY step"
        ),
        {"run": plain(run_id)},
    ).all()
    return {str(row.step): int(row.n) for row in rows}
