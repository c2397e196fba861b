"""Checks the gates of a protocol, that their measures exist and their limits are credible, and what its steps need.

A gate on a measure that the step does not yield would fail only when the step is done, hours into a run; a limit in a
wrong unit might pass everything. Gates are compared with the Measures of each step kind, by `orthocapture protocol
check` and whenever a run starts.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence

from service.core.arms import arm_model, known_arms
from service.core.checked_yaml import FieldPath, Plain, YamlProblem, field_name, parse_yaml, refuse
from service.core.errors import ConfigurationError, ProtocolError
from service.core.protocol import Gate, LoadedProtocol, Protocol, Step, motion_problems
from service.core.step_params import named_steps
from service.rig import Rig, RigDevice, RigSection
from service.steps import step_kinds
from service.steps.measures import Measure, RegistrationMeasures
from service.steps.registration import RegistrationParams, needing_mount

# Section and field of the file → its credible range, and its unit.
_SECTIONS: Mapping[tuple[str, str], tuple[float, float, str]] = {
    ("spheres", "radius_mm"): (1.0, 100.0, "mm"),
    ("board", "square_mm"): (0.5, 1000.0, "mm"),
    ("camera", "aperture_f"): (0.7, 64.0, ""),
    ("camera", "iso"): (25.0, 409600.0, ""),
    ("motion", "confirmed_for_s"): (10.0, 300.0, "s"),
}
NO_DEVICES: Mapping[str, RigDevice] = {}
_TERMS = {"camera": "camera", "scanner": "scanner", "ct": "CT source"}
_ALIAS = {"deg": "°", "1": "", "degrees": "°"}


def measures_of(step: Step, protocol_steps: Mapping[str, Step]) -> Mapping[str, Measure] | None:
    """Return the measures that a step with its parameters can yield; None if that cannot be determined."""
    kind = step_kinds().get(step.kind)
    if kind is None:
        return None
    if not issubclass(kind.measures, RegistrationMeasures):
        return kind.measures.declared()
    registering = kind.registered_by(step.params, protocol_steps) if kind.registered_by is not None else step
    return (
        None
        if registering is None or registering.gives != "registrations"
        else kind.measures.declared_for(registering.params_as(RegistrationParams).registrations)
    )


def implausible(
    loaded: LoadedProtocol, rig: RigSection | None = None, devices: Mapping[str, RigDevice] = NO_DEVICES
) -> tuple[YamlProblem, ...]:
    """Find unknown measures, wrong units, incredible limits, too fast motions and unknown stations; sort by line.

    Args:
        loaded: the protocol.
        rig: the rig in which it is to run, if that is known.
        devices: the drivers' statements about the rig's devices, by name.
    """
    tree = parse_yaml(loaded.source, name="the protocol")
    found: list[tuple[FieldPath, str]] = []
    data = tree.data if isinstance(tree.data, dict) else {}
    for (section, field), (least, most, unit) in _SECTIONS.items():
        part = data.get(section)
        value = part.get(field) if isinstance(part, dict) else None
        if isinstance(value, int | float) and not least <= value <= most:
            found.append(
                ((section, field), f"{value:g} {unit} is not credible: {least:g} to {most:g} {unit}".strip())
            )
    found += [
        (("data_set", *field), f"{error.what}. {error.remedy}")
        for field, error in loaded.protocol.data_set.problems().items()
    ]
    steps = {step.id: step for step in loaded.protocol.steps}
    for index, step in enumerate(loaded.protocol.steps):
        known = measures_of(step, steps)
        for number, gate in enumerate(step.gates) if known is not None else ():
            assert known is not None
            found += [(("steps", index, "gates", number, *at), words) for at, words in _gate(gate, step, known)]
        earlier = loaded.protocol.steps[:index]
        found += [
            (("steps", index, *at), words) for at, words in (*_named(step, earlier, steps), *_mount(step, steps))
        ]
    found += list(_too_fast(loaded.protocol, rig, devices))
    found += list(_too_late(loaded.protocol))
    if rig is not None:
        found += list(_stations(data, rig))
    problems = [YamlProblem(tree.line(at), field_name(at), words) for at, words in found]
    return tuple(sorted(problems, key=lambda p: (p.line, p.field)))


def require_plausible(
    loaded: LoadedProtocol, name: str, rig: RigSection | None = None, devices: Mapping[str, RigDevice] = NO_DEVICES
) -> None:
    """Refuse a protocol that `implausible` finds fault with; `name` is its file.

    Raises:
        ProtocolError: the message lists every problem with its line.
    """
    problems = implausible(loaded, rig, devices)
    if problems:
        remedy = "Correct it; docs/reference/steps.md lists the parameters, measures and units of each kind of step"
        refuse(problems, what="protocol", name=name, remedy=remedy, error=ProtocolError)


def require_devices(protocol: Protocol, rig: Rig, devices: Mapping[str, RigDevice]) -> None:
    """Refuse a rig without a device of a step which nobody may skip.

    Raises:
        ConfigurationError: the message names the first such step.
    """
    for step in protocol.steps:
        for needed in () if step.skippable else step.params.needed_devices:
            own = [
                name for name, one in devices.items() if one.kind == needed.kind and name not in rig.section.cameras
            ]
            if needed.name is None and len(own) != 1:
                raise ConfigurationError(
                    f"step {step.id} needs exactly one {_TERMS[needed.kind]}, the rig has {len(own)}",
                    where=str(rig.path),
                    remedy="Correct the devices of the rig file, or choose a protocol for this rig",
                )
            if needed.name is not None and needed.name not in own:
                raise ConfigurationError(
                    f"step {step.id} needs the {_TERMS[needed.kind]} {needed.name!r}, which the rig does not have",
                    where=str(rig.path),
                    remedy=f"Name it so among the devices; the rig has {', '.join(devices) or 'none'}",
                )


def _gate(gate: Gate, step: Step, known: Mapping[str, Measure]) -> Iterator[tuple[FieldPath, str]]:
    measure = known.get(gate.measure)
    if measure is None:
        near = difflib.get_close_matches(gate.measure, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else f"; it measures {', '.join(sorted(known))}"
        yield ("measure",), f"a step of kind {step.kind} measures no {gate.measure!r}{hint}"
        return
    unit = _ALIAS.get(gate.unit, gate.unit)
    if measure.unit and unit != measure.unit:
        yield ("unit",), f"{gate.measure} is in {measure.unit}, not in {gate.unit or 'nothing'}"
    for name, limit in (("min", gate.min), ("max", gate.max)):
        if limit is not None and limit != 0 and not measure.least <= limit <= measure.most:
            between = f"{measure.least:g} to {measure.most:g} {measure.unit}".strip()
            yield (name,), f"a limit of {limit:g} on {gate.measure} is not credible: {between}"


def _named(step: Step, earlier: Sequence[Step], steps: Mapping[str, Step]) -> Iterator[tuple[FieldPath, str]]:
    """Yield names in the params of a step that are not those of earlier steps, or of steps that do something else."""
    before = [one.id for one in earlier]
    for at, name, mark in named_steps(step.params):
        where = ("params", *at)
        if name not in steps:
            near = difflib.get_close_matches(name, before, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else f"; before it there are {', '.join(before) or 'none'}"
            yield where, f"there is no step {name!r}{hint}"
        elif name not in before:
            yield where, f"step {name!r} comes later; only earlier steps have results"
        elif not mark.fits(steps[name].params):
            yield where, f"{name!r} is a step of kind {steps[name].kind}, but only one that {mark.does} can be named"


def _mount(step: Step, steps: Mapping[str, Step]) -> Iterator[tuple[FieldPath, str]]:
    """Yield poses of an arm that a registration asks for although no step says how the arm held the camera."""
    if step.gives != "registrations":
        return
    wanted = step.params_as(RegistrationParams)
    unknown = needing_mount(wanted.poses)
    carried = [name for name in wanted.captures if name in steps and steps[name].moves_robot]
    if wanted.hand_eye is None and unknown and carried:
        yield (
            ("params",),
            f"the images of {carried[0]} are an arm's, and {' and '.join(unknown)} poses need its `hand_eye`; "
            "without it, `poses` are spheres, colmap or glomap",
        )


def _too_fast(
    protocol: Protocol, rig: RigSection | None, devices: Mapping[str, RigDevice]
) -> Iterator[tuple[FieldPath, str]]:
    """Yield the protocol's motion, if it moves an arm faster than that may move, or than it can stop in time."""
    if not any(step.moves_robot for step in protocol.steps):
        return
    named = None if rig is None else rig.collision.arm
    arms = known_arms() if named is None else [arm_model(named)]
    abandoned = [device.abandoned for device in devices.values() if device.abandoned is not None]
    strictest = min(abandoned, key=lambda one: one.rest_within_s - one.noticed_after_s, default=None)
    for field, words in motion_problems(protocol.motion, arms, strictest):
        yield ("motion", field), words


def _too_late(protocol: Protocol) -> Iterator[tuple[FieldPath, str]]:
    """Yield waits before a step that moves the robot tries again, after which the confirmation would have lapsed."""
    holds_s = protocol.motion.confirmed_for_s
    for index, step in enumerate(protocol.steps):
        if step.moves_robot and step.recovery.retries and step.recovery.wait_s >= holds_s:
            yield (
                ("steps", index, "recovery", "wait_s"),
                f"after {step.recovery.wait_s:g} s the robot does not try again by itself: a confirmation holds for "
                f"{holds_s:g} s without progress (motion.confirmed_for_s)",
            )


def _stations(data: Mapping[str, Plain], rig: RigSection) -> Iterator[tuple[FieldPath, str]]:
    """Yield stations that the protocol names but the rig file does not have."""

    def walk(value: Plain, at: FieldPath) -> Iterator[tuple[FieldPath, str]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                if key == "station" and isinstance(inner, str) and inner not in rig.stations:
                    there = ", ".join(rig.stations) or "none"
                    near = difflib.get_close_matches(inner, rig.stations, n=1)
                    hint = f"; did you mean {near[0]!r}?" if near else f"; it has {there}"
                    yield (*at, key), f"the rig has no station {inner!r}{hint}"
                else:
                    yield from walk(inner, (*at, key))
        elif isinstance(value, list):
            for number, inner in enumerate(value):
                yield from walk(inner, (*at, number))

    yield from walk(data.get("steps"), ("steps",))
