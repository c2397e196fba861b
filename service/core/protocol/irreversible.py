"""What a person reads before a step that changes the scene for good."""

from __future__ import annotations

from itertools import takewhile

from service.core.protocol.models import Protocol, Step


def irreversible_warning(protocol: Protocol, step: Step) -> str:
    """Say in plain words what cannot be undone after this step, and what is judged only when it is too late."""
    at = protocol.index(step.id)
    closed = [s.title for s in protocol.steps[:at] if s.photographs_specimen or s.id in step.requires]
    afterwards = [s.title for s in takewhile(lambda s: not s.begins_confirmed, protocol.steps[at + 1 :]) if s.gates]
    words = [step.cannot_be_undone or "This step changes the scene for good."]
    if closed:
        words.append(f"None of these can be done again: {', '.join(closed)}.")
    if afterwards:
        words.append(
            f"What is judged only afterwards can then be computed again, accepted where the protocol allows it, or "
            f"left as it is, but no longer be mended by new measurements: {', '.join(afterwards)}."
        )
    return " ".join([*words, "Read the figures before you go on."])
