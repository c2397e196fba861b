"""What `dataset.json` says of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from service.core.gates.acceptance import accepted_gates
from service.core.gates.verdict import BOUNDS_HOLD
from service.dataset.late_results import late_results
from service.dataset.posed.of_run.about_run import gates_in_words, origin_sentence
from service.dataset.registrations import shared_adjustment_note
from service.dataset.summary import RunSummary


def described_run(
    summary: RunSummary, own: str, not_in_yet: Sequence[str], *, personal: bool = True
) -> dict[str, Any]:
    """What `dataset.json` says of the run, as plain data; `own` is the name of its registration."""
    later = summary.better_later()
    return {
        "run": summary.run_id,
        "simulated": summary.root.simulated,
        "origin": summary.root.origin,
        "origin_in_words": origin_sentence(summary, personal=personal),
        "protocol": f"{summary.root.protocol_id} {summary.root.protocol_version}",
        "protocol_sha256": summary.root.protocol_sha256,
        "frame": "scan",
        "unit": "m",
        "pose_source": own,
        "evaluation": [row.plain() for row in summary.table()],
        "gates": gates_in_words(summary),
        "gates_explained": BOUNDS_HOLD,
        "accepted_gates": [gate.text for gate in accepted_gates(summary.protocol, summary.state)],
        "evaluation_note": shared_adjustment_note(summary.protocol, summary.state),
        "arrived_later": [late.text for late in late_results(summary.protocol, summary.state)],
        "arrived_later_and_better": None if later is None else later.poses,
        "not_in_yet": list(not_in_yet),
        "deviations": [d.text for d in summary.state.deviations],
        "head_of_chain_sha256": summary.events[-1].sha256,
    }
