"""The lab procedure as typed data: models of the protocol file, rules beyond their types, loader, JSON Schema."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, TypeVar, Union, cast

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    SerializeAsAny,
    TypeAdapter,
    WithJsonSchema,
    create_model,
)

from service.core.checked_yaml import (
    FieldPath,
    Plain,
    YamlProblem,
    YamlTree,
    checked,
    decoded,
    did_you_mean,
    field_name,
    parse_yaml,
    refuse,
)
from service.core.errors import ProtocolError
from service.core.records.base import Record
from service.core.records.data_set import DataSetStatement
from service.core.run.lifecycle import RESERVED_STEP_IDS
from service.core.step_params import Gives, RepeatedStep, StepParams

if TYPE_CHECKING:
    from drivers.interfaces import Abandoned
    from service.core.arms import ArmModel

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


_Text = Annotated[str, Field(min_length=3, max_length=200)]


class Reasons(Record):
    """A protocol's preset reasons by action. Free text can always be added, and the full text is recorded."""

    # Offered for a redo.
    redo: tuple[_Text, ...] = (
        "Images are blurred or badly lit",
        "The specimen, the board or a sphere has moved",
        "Something stood in the view",
        "A device gave a wrong or incomplete result",
        "Confirmed by mistake, or before everything was ready",
    )
    # Offered for a skip.
    skip: tuple[_Text, ...] = (
        "Not part of this acquisition",
        "A device is out of order",
        "Done already, outside of this run",
        "No time is left for it",
    )
    # Offered where figures outside their limits are accepted.
    accept: tuple[_Text, ...] = (
        "Only just outside; enough for the purpose of this run",
        "Another figure shows that the result can be used",
        "It cannot be repeated: the specimen has changed",
    )


def full_reason(preset: str, own: str) -> str:
    """Return the reason that is recorded: the chosen preset, then the operator's own text."""
    return ": ".join(part for part in (preset.strip(), own.strip()) if part)


ParamsT = TypeVar("ParamsT", bound=StepParams)


def _fraction(value: Any) -> Any:
    """Read a shutter speed in seconds, also as a fraction such as `1/15`. Raises ValueError."""
    if not isinstance(value, str):
        return value
    numerator, slash, denominator = value.partition("/")
    try:
        return float(numerator) / (float(denominator) if slash else 1.0)
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"{value!r} is neither a number of seconds nor a fraction such as 1/15") from None


def _not_reserved(value: str) -> str:
    if value in RESERVED_STEP_IDS:
        raise ValueError(f"{value!r} is the name of a state of the run; choose another")
    return value


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Text = Annotated[str, Field(min_length=1)]
StepId = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$"), AfterValidator(_not_reserved)]
Exposure = Annotated[
    float,
    Field(gt=0, allow_inf_nan=False),
    BeforeValidator(_fraction),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "number", "exclusiveMinimum": 0},
                {"type": "string", "pattern": r"^[0-9.]+/[0-9.]+$", "examples": ["1/15"]},
            ]
        }
    ),
]


class Spheres(Record):
    """The reference spheres on and around the specimen."""

    radius_mm: Positive  # the radius of each sphere
    registration: Annotated[int, Field(ge=4)]  # the number of registration spheres
    control: Annotated[int, Field(ge=0)] = 0  # the number of control spheres; they take no part in the registration
    # If it is not given, the detector learns it from the clearest spheres of each image.
    colour: Annotated[str, Field(pattern=r"^(white|grey|green|orange|#[0-9a-fA-F]{6})$")] | None = None


class CalibrationBoard(Record):
    """The calibration checkerboard, counted in inner corners."""

    columns: Annotated[int, Field(ge=3)]  # inner corners in a row
    rows: Annotated[int, Field(ge=3)]  # inner corners in a column
    square_mm: Positive  # side of a square
    # Largest bow of the board, as the maker gives it; 0: exactly flat; default: 0.2.
    flatness_mm: Annotated[float, Field(ge=0, le=5)] | None = None
    # Largest error of the square's side, in percent of it, as the maker gives it; default: 0.05 (0.1 mm in 200 mm).
    size_tolerance_percent: Annotated[float, Field(ge=0, le=20)] | None = None


class CameraSection(Record):
    """The camera settings that stay fixed through the run."""

    aperture_f: Positive  # f-number
    exposure_s: Exposure  # seconds, or a fraction such as 1/15
    iso: Annotated[int, Field(gt=0)]  # sensitivity
    focus_mode: Text = "Manual"  # the camera's name for it
    image_quality: Literal["JPEG", "RAW", "RAW+JPEG"] = "JPEG"  # the files that the camera writes


class Motion(Record):
    """The arm's motion between viewpoints."""

    speed_rad_s: Positive = 0.5  # the speed of the fastest joint
    acceleration_rad_s2: Positive = 0.5  # the acceleration of the fastest joint
    dwell_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.5  # between standing still and the exposure
    # How long a confirmation lets the arm set out without visible progress; then it is asked for again.
    confirmed_for_s: Positive = 60.0


class Settle(Record):
    """The conditions on which the arm counts as standing still, and the longest wait for them."""

    window_s: Positive = 0.5  # over which all limits must hold
    joint_speed_rad_s: Positive = 0.001  # largest of any joint
    tcp_speed_m_s: Positive = 0.0002  # largest of the flange
    position_peak_to_peak_m: Positive = 0.00002  # range of the flange's position within the window
    rotation_peak_to_peak_rad: Positive = 0.0000873  # range of the flange's rotation within the window
    timeout_s: Positive = 20.0  # then the viewpoint fails


# Who may accept a gate outside its limits. `another_supervisor` neither began the run nor confirmed the step.
AcceptedBy = Literal["supervisor", "another_supervisor"]


class Gate(Record):
    """A measured number and its limits; a step passes when all its gates are within limits or are accepted."""

    measure: Text  # name of a number that the step measures
    min: Finite | None = None  # smallest value that passes
    max: Finite | None = None  # largest value that passes
    unit: str = ""  # the unit of the limits; checked against the unit of the measure
    why: str = ""  # the reason for the limit, for people
    unless_skipped: str | None = None  # the earlier step that the number needs: if it is skipped, there is no gate
    accept_by: AcceptedBy | None = None  # None: nobody may; see service.core.gates


class Recovery(Record):
    """The response to failed work of a step (service.core.recovery)."""

    retries: Annotated[int, Field(ge=0, le=20)] = 2  # after transient device errors without progress in between
    wait_s: Annotated[float, Field(ge=0, le=600)] = 1.0  # before a retry
    # When no retry is left a person is asked; with `abort`, to end the run is what the question recommends.
    on_failure: Literal["ask", "abort"] = "ask"


class HandAction(Record):
    """The technician's work by hand when confirming this step; a simulated rig does it by itself."""

    action: Text  # the action that the simulator is asked for
    station: str | None = None  # where
    device: str | None = None  # the rig's device that is used


class StepFields(Record):
    """The fields of a step other than its params."""

    id: StepId  # name in the record, unique in the protocol
    kind: Text  # the work of the step: one of the step kinds
    title: Text  # the title that people read
    why: str = ""  # the reason, for the technician
    instructions: str = ""  # the technician's work, as text
    # In service/web/drawings, shown beside the instructions; "": that of the step kind. A checklist with `camera`
    # offers the live view, because the lens is focused there.
    drawing: str = ""
    checklist: tuple[Text, ...] = ()  # items to tick before the step can be confirmed
    gates: tuple[Gate, ...] = ()  # measured numbers with their limits
    sign: bool = False  # true if a person signs before the step passes
    confirm: bool = True  # true if a person starts it; a step that moves the robot always waits for one
    skippable: bool = False  # true if a person may skip it, with a reason
    irreversible: bool = False  # true if nothing before it can be done again afterwards
    cannot_be_undone: str = ""  # the sentence that a person reads before an irreversible step
    requires: tuple[str, ...] = ()  # earlier steps that must not have been skipped
    # How long the work usually takes, in seconds; used until this site has measured it. None: not known.
    takes_s: Positive | None = None
    recovery: Recovery = Recovery()  # the response to failed work
    simulated_hands: tuple[HandAction, ...] = ()  # ignored on a real rig


class Step(StepFields):
    """One step of the procedure; `params` is an instance of its kind's Params model."""

    params: SerializeAsAny[StepParams]

    @property
    def moves_robot(self) -> bool:
        """True if the robot moves during this step; confirming it takes a held button or two pedal presses."""
        return self.params.moves_robot

    @property
    def repeated(self) -> RepeatedStep:
        """The meaning of trying this step again."""
        return self.params.repeated

    @property
    def gives(self) -> Gives | None:
        """The kind of result that other steps look for in this one; None if there is none."""
        return self.params.gives

    @property
    def by_hand(self) -> bool:
        """True if a person takes this step's images with the camera in the hand."""
        return self.params.by_hand

    @property
    def photographs_specimen(self) -> bool:
        """True if this step takes images of the specimen."""
        return self.params.photographs_specimen

    @property
    def needs_disk(self) -> bool:
        """True if this step stores files."""
        return self.params.needs_disk

    @property
    def begins_confirmed(self) -> bool:
        """True if a person must let it begin; always so if it moves the robot, whatever the protocol says."""
        return self.confirm or self.moves_robot

    def params_as(self, model: type[ParamsT]) -> ParamsT:
        """Return the params, typed. Raises ProtocolError when the step is of another kind."""
        if not isinstance(self.params, model):
            raise ProtocolError(f"the params of this step are not {model.__qualname__}", where=f"step {self.id}")
        return self.params


class ProtocolFields(Record):
    """The fields of a protocol other than its steps."""

    id: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]  # name in the record and on the pages
    version: Text  # changes with the content
    title: Text  # the title that people read
    source: str = ""  # the source of the procedure
    spheres: Spheres  # radius and number of the spheres
    board: CalibrationBoard | None = None  # the calibration board; needed by a step that calibrates
    camera: CameraSection | None = None  # None: no settings are required, and no step sets a camera
    motion: Motion = Motion()  # speed and acceleration of the arm
    settle: Settle = Settle()  # the conditions on which the arm counts as standing still
    # Whether a person who took no part in the run must release it before anything is exported.
    release: Literal["none", "second_person"] = "none"
    reasons: Reasons = Reasons()  # presets for the reason of a redo, a skip or an acceptance
    data_set: DataSetStatement = DataSetStatement()  # the statement of an exported data set about itself


class Protocol(ProtocolFields):
    """A lab procedure."""

    steps: tuple[Step, ...]

    @property
    def step_ids(self) -> tuple[str, ...]:
        """Identifiers of the steps, in order."""
        return tuple(step.id for step in self.steps)

    def step(self, step_id: str) -> Step:
        """Return the step with this identifier. Raises ProtocolError if there is none."""
        return self.steps[self.index(step_id)]

    def index(self, step_id: str) -> int:
        """Return the step's position. Raises ProtocolError if there is none."""
        try:
            return self.step_ids.index(step_id)
        except ValueError:
            raise ProtocolError(
                f"no step {step_id!r}", where=self.id, remedy=f"Steps: {', '.join(self.step_ids)}"
            ) from None


@dataclass(frozen=True)
class LoadedProtocol:
    """A protocol, the hash of its file's bytes, and its text."""

    protocol: Protocol
    sha256: str
    source: str


class _FileStep(StepFields):
    params: dict[str, Any] = Field(default_factory=dict)


class _FileProtocol(ProtocolFields):
    steps: Annotated[tuple[_FileStep, ...], Field(min_length=1)]


def load_protocol(path: Path, params_models: Mapping[str, type[StepParams]]) -> LoadedProtocol:
    """Read a protocol file; `params_models` maps every known step kind to its Params.

    Raises:
        ProtocolError: the file cannot be read or is wrong; the message lists every problem with file:line and field.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ProtocolError(
            f"cannot read the protocol: {error.strerror}", where=str(path), remedy="Check the path"
        ) from error
    return parse_protocol(content, params_models, name=str(path))


def parse_protocol(content: bytes, params_models: Mapping[str, type[StepParams]], *, name: str) -> LoadedProtocol:
    """Read a protocol from a file's bytes (a recorded artefact, an editor's buffer).

    Args:
        content: the file's bytes.
        params_models: the Params model of each step kind.
        name: the file's name in error messages.

    Raises:
        ProtocolError: the protocol is wrong; the message lists every problem with file:line and field.
    """
    text = decoded(content, name=name, error=ProtocolError)
    tree = parse_yaml(text, name=name)
    problems = list(tree.problems)
    data = tree.data if isinstance(tree.data, dict) else {}
    if not isinstance(tree.data, dict):
        problems.append(YamlProblem(1, "", "not a protocol: the file must hold fields such as id, version and steps"))
        _refuse(problems, name)
    parsed, found = checked(data, _FileProtocol, tree)
    problems += found
    problems += [YamlProblem(tree.line(at), field_name(at), message) for at, message in rule_violations(data)]
    params = _validate_params(data, params_models, tree, problems)
    if problems or parsed is None:
        _refuse(problems, name)
    steps = tuple(
        Step(params=params[index], **{field: getattr(step, field) for field in StepFields.model_fields})
        for index, step in enumerate(parsed.steps)
    )
    fields = {field: getattr(parsed, field) for field in ProtocolFields.model_fields}
    return LoadedProtocol(Protocol(steps=steps, **fields), hashlib.sha256(content).hexdigest(), text)


def _validate_params(
    data: Mapping[str, Plain], models: Mapping[str, type[StepParams]], tree: YamlTree, problems: list[YamlProblem]
) -> dict[int, StepParams]:
    """Return the params of every valid step by its index; appends what is wrong with the others to `problems`."""
    params: dict[int, StepParams] = {}
    steps = data.get("steps")
    for index, step in enumerate(steps if isinstance(steps, list) else []):
        if not isinstance(step, dict) or not isinstance(step.get("kind"), str):
            continue
        kind, at = str(step["kind"]), ("steps", index)
        if kind not in models:
            message = f"unknown kind {kind!r}{did_you_mean(kind, models)}; kinds: {', '.join(sorted(models))}"
            problems.append(YamlProblem(tree.line((*at, "kind")), field_name((*at, "kind")), message))
            continue
        given = step.get("params", {})
        if not isinstance(given, dict):
            continue  # already reported by the check of the structure
        found, wrong = checked(given, models[kind], tree, (*at, "params"))
        problems += wrong
        if found is not None:
            params[index] = found
    return params


def _refuse(problems: list[YamlProblem], name: str) -> NoReturn:
    remedy = "See docs/reference/protocol.schema.json for what a protocol may hold"
    refuse(problems, what="protocol", name=name, remedy=remedy, error=ProtocolError)


def protocol_json_schema(params_models: Mapping[str, type[StepParams]]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a protocol file for editors, with the params of every step kind."""
    kinds: list[type[BaseModel]] = []
    for kind, model in sorted(params_models.items()):
        needed = any(field.is_required() for field in model.model_fields.values())
        default: Any = ... if needed else Field(default_factory=model)
        fields: dict[str, Any] = {"kind": (Literal[kind], ...), "params": (model, default)}
        kinds.append(create_model(f"Step_{kind}", __base__=StepFields, __doc__=f"A step of kind {kind}.", **fields))
    # A union built at run time, which pydantic understands and the type checker does not.
    step = cast(Any, Union)[tuple(kinds)]
    if len(kinds) > 1:
        step = Annotated[step, Field(discriminator="kind")]
    steps: Any = (Annotated[tuple[step, ...], Field(min_length=1)], ...)
    whole = create_model("Protocol", __base__=ProtocolFields, __doc__="An orthocapture protocol.", steps=steps)
    schema = TypeAdapter(whole).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def irreversible_warning(protocol: Protocol, step: Step) -> str:
    """Say what cannot be undone after this step, and what is judged only when it is too late."""
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


_ROUNDING_S = 1e-9


def motion_problems(
    motion: Motion, arms: Sequence[ArmModel], abandoned: Abandoned | None
) -> Iterator[tuple[str, str]]:
    """Yield the fields of a protocol's motion that are too large, with a text that says for what.

    Args:
        motion: the protocol's section; its speed and acceleration are those of the fastest joint, whichever that is.
        arms: those that may be meant, at least one; a motion is too fast if it is so for each of them.
        abandoned: when the controller notices that the program died, and how soon the arm must stand; None if the
            device sees to that by itself.
    """
    arm = max(arms, key=lambda one: float(one.speeds_rad_s.min()))
    among = f"a {arm.name}" if len(arms) == 1 else f"a {arm.name}, the fastest arm that is known,"
    joint = int(np.argmin(arm.speeds_rad_s))
    most_rad_s = float(arm.speeds_rad_s[joint])
    if motion.speed_rad_s > most_rad_s:
        yield "speed_rad_s", f"joint {joint + 1} of {among} turns by {most_rad_s:.2f} rad/s at most"
    most_rad_s2 = max(one.acceleration_rad_s2 for one in arms)
    if motion.acceleration_rad_s2 > most_rad_s2:
        yield "acceleration_rad_s2", f"the controller of {among} takes {most_rad_s2:g} rad/s² at most"
    if abandoned is None:
        return
    braking_rad_s2 = max(one.braking_rad_s2 for one in arms)
    rests_after_s = abandoned.noticed_after_s + motion.speed_rad_s / braking_rad_s2
    if rests_after_s > abandoned.rest_within_s + _ROUNDING_S:
        slow_enough_rad_s = max(0.0, abandoned.rest_within_s - abandoned.noticed_after_s) * braking_rad_s2
        yield (
            "speed_rad_s",
            f"if the program dies, the arm stands after {rests_after_s:.2f} s ({abandoned.noticed_after_s:g} s until "
            f"that is noticed, then braking with {braking_rad_s2:g} rad/s²), and rest_within_s of the rig file "
            f"allows {abandoned.rest_within_s:g} s: move with {slow_enough_rad_s:.2f} rad/s at most",
        )
