"""When the specimen of a run is freed, and when the run may be exported.

A specimen is freed; a run is released, by a second person where the protocol asks for it, and its data with it.
"""

from __future__ import annotations

from datetime import datetime

from service.core.errors import IllegalTransitionError
from service.core.protocol.models import Protocol
from service.core.run.state import RunState
from service.core.text.words import counted

_NAMED = 20  # deviations that the text of a release names; the record has the others


def release_meaning(state: RunState) -> str:
    """Return what a person declares who releases the run: that they read it, and with which deviations."""
    texts = [f"{one.kind.replace('_', ' ')}, {' '.join(one.text.split()).rstrip('.')}" for one in state.deviations]
    if not texts:
        return "I have read this run, in which nothing deviated from the protocol, and release it"
    more = f"; and {len(texts) - _NAMED} more" if len(texts) > _NAMED else ""
    named = "; ".join(texts[:_NAMED])
    return f"I have read this run and release it with its {counted(len(texts), 'deviation')}: {named}{more}"


def loses_release(protocol: Protocol, state: RunState, actor: str) -> bool:
    """Return whether a person who acts on the run now can no longer release it as the second person."""
    return protocol.release == "second_person" and not state.released_by and actor not in state.people


def refuse_release(state: RunState, actor: str, signed_sha256: str) -> IllegalTransitionError | None:
    """Return the reason why this person cannot release the run by signing this hash, or None."""
    if state.status != "completed":
        return IllegalTransitionError(
            f"the run is {state.status}", where="release", remedy="Only a completed run can be released"
        )
    if state.released_by:
        return IllegalTransitionError(f"{state.released_by} has released the run already", where="release")
    if actor in state.people:
        return IllegalTransitionError(
            f"{actor} took part in this run", where="release", remedy="A second person checks and releases it"
        )
    if signed_sha256 != state.completed_sha256:
        return IllegalTransitionError(
            "the signature is for a record other than the end of this run",
            where="release",
            remedy="Read the run again and sign it as it is now",
        )
    return None


def refuse_export(protocol: Protocol, state: RunState) -> IllegalTransitionError | None:
    """Return the reason why the run may not be exported yet, for want of a release, or None."""
    if protocol.release == "second_person" and not state.released_by:
        return IllegalTransitionError(
            "the protocol asks for a second person's release before anything is exported",
            where=state.run_id,
            remedy="A supervisor who took no part in the run reads it and signs its release, on the page or with "
            "`orthocapture audit release`",
        )
    return None


def refuse_data_set(state: RunState) -> IllegalTransitionError | None:
    """Return the reason why there is no data set of the run yet, or None."""
    if state.status != "completed":
        return IllegalTransitionError(
            f"the run is {state.status}", where=state.run_id, remedy="Only a completed run is exported"
        )
    return None


_ANSWERS = ("registrations", "accuracy")  # what must be known before a specimen is freed


def freed_utc(protocol: Protocol, state: RunState) -> str:
    """Return when the specimen was freed, so that nothing can be measured again (ISO 8601, UTC); "" before that.

    That is when the first irreversible step that requires a registration or an evaluation passed, or else the end of
    the run.
    """
    return _freed_by_step_utc(protocol, state) or (state.ended_utc if state.status == "completed" else "")


def late_s(protocol: Protocol, state: RunState, now_utc: str) -> float | None:
    """Return the seconds from `freed_utc` to a result that arrives at `now_utc`; None if it is in time."""
    freed = freed_utc(protocol, state)
    if not freed:
        return None
    return max(0.0, (datetime.fromisoformat(now_utc) - datetime.fromisoformat(freed)).total_seconds())


def late_words(protocol: Protocol, state: RunState, seconds: float) -> str:
    """Return a delay as text, such as `arrived 12 min after the specimen was freed`."""
    since = "the specimen was freed" if _freed_by_step_utc(protocol, state) else "the end of the run"
    minutes = round(seconds / 60)
    return f"arrived {minutes} min after {since}" if minutes else f"arrived after {since}"


def _freed_by_step_utc(protocol: Protocol, state: RunState) -> str:
    for step in protocol.steps:
        rests = any(protocol.step(name).gives in _ANSWERS for name in step.requires)
        if step.irreversible and rests and state.steps[step.id].phase == "passed":
            return state.steps[step.id].ended_utc
    return ""
