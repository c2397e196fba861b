"""The lab procedure as typed data: the protocol file's models, its loader and its JSON Schema."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, cast

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

from service.core.errors import ProtocolError
from service.core.protocol.rules import rule_violations
from service.core.protocol.step_params import Gives, RepeatedStep, StepParams
from service.core.records.data_set import DataSetStatement
from service.core.records.events import Record
from service.core.run.lifecycle import RESERVED_STEP_IDS
from service.core.text.checked_yaml import (
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
    accept_by: AcceptedBy | None = None  # None: nobody may; see service.core.gates.acceptance


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
    # In service/web/run/drawings, shown beside the instructions; "": that of the step kind. A checklist with `camera`
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
