"""The words of the run page: what a confirmation does, what a step shows, limits of measured numbers."""

from __future__ import annotations

from service.core.gates.measure_names import measure_name
from service.core.gates.verdict import Standing, figure, standing
from service.core.protocol.models import Protocol, Step
from service.core.records.events import GateVerdict
from service.core.recovery import WayOn, planned_sets, planned_views
from service.core.run.decide import AskOperator
from service.core.run.noted import Mending
from service.core.run.state import RunState, StepState
from service.steps import step_kinds
from service.steps.context import ROBOT_MOVES, Announcement, BeforeStep


def drawing_of(step: Step) -> str:
    """Name of the drawing that shows the step, "" for none: the protocol's own choice, else that of its kind."""
    kind = step_kinds().get(step.kind)
    return step.drawing or (kind.drawing if kind is not None else "")


def limit(minimum: float | None, maximum: float | None, unit: str = "") -> str:
    """Return the limits in words: `at least 0.2 and at most 1 mm`, `exactly 13 spheres`."""
    if minimum is not None and minimum == maximum:
        return f"exactly {minimum:g} {unit}".rstrip()
    low = "" if minimum is None else f"at least {minimum:g}"
    high = "" if maximum is None else f"at most {maximum:g}"
    return f"{' and '.join(text for text in (low, high) if text) or 'no limit'} {unit}".rstrip()


def sentence(text: str) -> str:
    """Begin with a capital letter and end with a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def station_of(step: Step) -> str:
    """`station 1` of a capture step; "" for others."""
    return " and ".join(dict.fromkeys(str(one.station).replace("_", " ") for one in planned_sets(step)))


def count(amount: int, one: str, many: str = "") -> str:
    """`1 image`, `8 images`."""
    return f"{amount} {one if amount == 1 else many or one + 's'}"


def will_happen(step: Step, now: StepState) -> tuple[str, str]:
    """What a confirmation of this step does: the large words of its button, and a line below."""
    kind = step_kinds().get(step.kind)
    left = max(planned_views(step) - len(now.captured), 0)
    before = BeforeStep(step.title, left, station_of(step))
    said = kind.words(step.params, before) if kind is not None and kind.words is not None else None
    if said is None:
        moves = step.moves_robot
        begin = f"begin {step.title[:1].lower()}{step.title[1:]}"
        said = Announcement(begin, ROBOT_MOVES) if moves else Announcement(begin)
    return f"Confirm: {said.does}", said.below


def figure_line(verdict: GateVerdict) -> str:
    """One figure of what is signed or did not pass."""
    allowed = limit(verdict.minimum, verdict.maximum, verdict.unit)
    undecided = "; not decided" if verdict.undecided else ""
    return f"{measure_name(verdict.measure)} {figure(verdict)} ({allowed}{undecided})"


def needs(verdict: GateVerdict) -> str:
    """What a gate lacks: `Coverage 0.896, needs at least 0.9`."""
    allowed = limit(verdict.minimum, verdict.maximum, verdict.unit)
    undecided = ", not decided" if verdict.undecided else ""
    return f"{measure_name(verdict.measure)} {figure(verdict)}, needs {allowed}{undecided}"


def stopped_words(protocol: Protocol, state: RunState, question: AskOperator) -> str:
    """Why a run is stopped and what is recommended: `Coverage 0.896, needs at least 0.9 → take these 6 views`."""
    now = state.step
    failed = [needs(verdict) for verdict in now.verdicts if not verdict.passed]
    if now.failure is not None:
        why = sentence(now.failure.message).rstrip(".")
    else:
        why = "; ".join(failed) or sentence(question.text).rstrip(".")
    way = next((way for way in question.ways if way.available), None)
    return f"{why} → {way_words(state, way)}" if way is not None else why


def way_words(state: RunState, way: WayOn) -> str:
    """A way on in few words, with a small letter: the views that mend are counted, an advice is cut at its end."""
    mends = state.step.mend or Mending()
    views = len(mends.viewpoints)
    if way.verb == "confirm" and views:
        return f"take {'this view' if views == 1 else f'these {views} views'}"
    boards = len(mends.poses)
    if way.verb == "confirm" and boards:
        return f"take {boards} more {'image' if boards == 1 else 'images'} of the board"
    words = way.words.split(";")[0].split(". ")[0].rstrip(".")
    return words[:1].lower() + words[1:]


_STANDINGS: dict[Standing, tuple[str, str]] = {
    "within": ("Within", "ok"),
    "not_decided": ("Not decided", "attention"),
    "accepted": ("Accepted", "attention"),
    "outside": ("Outside", "stop"),
}


def gate_word(verdict: GateVerdict, *, accepted: bool = False) -> tuple[str, str]:
    """The outcome of a gate as a word and its tone. `accepted`: a person accepted the figures outside the limits."""
    return _STANDINGS[standing(verdict, accepted=accepted)]


def phase_words(state: RunState, step: StepState, *, stopped: bool = False) -> tuple[str, str, str]:
    """A step's status in the list of steps: word, tone, icon. `stopped`: the current one needs a decision."""
    if step.skipped:
        return "skipped", "skipped", "skip"
    if step.phase == "passed" and step.accepted is not None:
        return "accepted outside its limits", "skipped", "attention"
    if step.phase == "passed":
        return "passed", "passed", "ok"
    if step.step == state.current and not state.terminal:
        return ("stopped", "stopped", "fail") if stopped else ("now", "current", "now")
    if state.terminal and step.step == state.current:
        return "stopped here", "current", "fail"
    return "to come", "pending", "open"
