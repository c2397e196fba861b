"""Rules for a protocol beyond the types of its fields; on plain data, so that all problems are reported at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import cast

from service.core.text.checked_yaml import FieldPath, Plain

# Measures that no protocol may allow anybody to accept: outside their limits an image or the evidence itself is
# invalid, and no judgement can change that. Measure → what is wrong then.
NEVER_ACCEPTED: Mapping[str, str] = {
    "settings_departures": "means images taken with other settings than the calibration's",
    "optics_departures": "means images taken through other optics than the calibrated ones",
    "moved_during_exposure": "means images whose pose is not known",
    "checklist_items_open": "means that work was not done which the record says is done",
    "checklist_items_ticked": "means that work was not done which the record says is done",
    "applications": "means that no coat was applied",
}


def rule_violations(data: dict[str, Plain]) -> Iterator[tuple[FieldPath, str]]:
    """Yield (field, what is wrong) for the data of a protocol file, which may be malformed in any way."""
    steps = data.get("steps")
    seen: dict[str, int] = {}
    for index, step in enumerate(steps if isinstance(steps, list) else []):
        if isinstance(step, dict):
            at: FieldPath = ("steps", index)
            yield from _identity(step, at, seen)
            yield from _requires(step, at, seen, _all_ids(cast(list[Plain], steps)))
            yield from _irreversible(step, at)
            yield from _gates(step, at, seen, cast(list[Plain], steps))
            if isinstance(step.get("id"), str):
                seen.setdefault(str(step["id"]), index)


def _all_ids(steps: list[Plain]) -> set[str]:
    return {str(step["id"]) for step in steps if isinstance(step, dict) and isinstance(step.get("id"), str)}


def _identity(step: dict[str, Plain], at: FieldPath, seen: dict[str, int]) -> Iterator[tuple[FieldPath, str]]:
    step_id = step.get("id")
    if isinstance(step_id, str) and step_id in seen:
        yield (*at, "id"), f"duplicate step id {step_id!r}, first used by steps[{seen[step_id]}]"


def _requires(
    step: dict[str, Plain], at: FieldPath, seen: dict[str, int], everyone: set[str]
) -> Iterator[tuple[FieldPath, str]]:
    required = step.get("requires")
    for index, name in enumerate(required if isinstance(required, list) else []):
        if not isinstance(name, str) or name in seen:
            continue
        if name == step.get("id"):
            message = "a step cannot require itself"
        elif name in everyone:
            message = f"step {name!r} comes later; only earlier steps can be required"
        else:
            message = f"there is no step {name!r}"
        yield (*at, "requires", index), message


def _irreversible(step: dict[str, Plain], at: FieldPath) -> Iterator[tuple[FieldPath, str]]:
    if step.get("irreversible") is not True:
        return
    where: FieldPath = (*at, "irreversible")
    if not step.get("requires"):
        yield where, "an irreversible step needs `requires`: the captures that must have passed before it"
    if step.get("sign") is not True:
        yield where, "an irreversible step needs `sign: true`: a person approves that it begins"
    if step.get("confirm") is False:
        yield (*at, "confirm"), "an irreversible step is always confirmed by a person"


def _gates(
    step: dict[str, Plain], at: FieldPath, seen: dict[str, int], steps: list[Plain]
) -> Iterator[tuple[FieldPath, str]]:
    gates = step.get("gates")
    measures: set[str] = set()
    for index, gate in enumerate(gates if isinstance(gates, list) else []):
        if not isinstance(gate, dict):
            continue
        where: FieldPath = (*at, "gates", index)
        low, high = gate.get("min"), gate.get("max")
        if low is None and high is None:
            yield where, "a gate needs limits: min, max or both"
        if _number(low) and _number(high) and cast(float, low) > cast(float, high):
            yield (*where, "max"), f"min {low} is above max {high}: nothing could pass"
        unless = gate.get("unless_skipped")
        if isinstance(unless, str):
            named = steps[seen[unless]] if unless in seen else None
            if not isinstance(named, dict) or named.get("skippable") is not True:
                yield (*where, "unless_skipped"), f"{unless!r} is not an earlier step that may be skipped"
        measure = gate.get("measure")
        if isinstance(measure, str):
            if gate.get("accept_by") is not None and measure in NEVER_ACCEPTED:
                yield (
                    (*where, "accept_by"),
                    f"{measure!r} outside its limits {NEVER_ACCEPTED[measure]}: nobody accepts it",
                )
            if measure in measures:
                yield (*where, "measure"), f"a second gate on {measure!r}; give min and max in one gate"
            measures.add(measure)


def _number(value: Plain) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
