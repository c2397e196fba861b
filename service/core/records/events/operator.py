"""Events of what people did in a run."""

from __future__ import annotations

from typing import Any, Literal

from service.core.records.base import Record

OperatorVerb = Literal["confirm", "sign", "redo", "skip", "accept", "pause", "resume", "abort"]
# How the person was identified: by a secret of the account, or only by claim (a site without accounts).
Identified = Literal["", "claimed", "password", "pin", "badge"]


class OperatorAction(Record):
    """A person's action. `automatic` marks a confirmation given by --auto-confirm on a simulated rig."""

    kind: Literal["operator_action"] = "operator_action"
    action: OperatorVerb
    step: str | None = None
    viewpoint: str | None = None  # redo of a single viewpoint
    reason: str = ""
    checklist: tuple[str, ...] = ()  # items ticked
    meaning: str = ""  # the meaning of a signature
    signed_sha256: str = ""  # hash of the event that was signed
    role: str = ""  # the person's role, where the action demands one
    identified: Identified = ""
    via: Literal["cli", "web", "pedal", "auto"] = "cli"
    automatic: bool = False


class ActionRefused(Record):
    """An action that the lifecycle or the protocol did not allow; recorded without effect."""

    kind: Literal["action_refused"] = "action_refused"
    action: OperatorVerb
    step: str | None
    why: str


class ItemTicked(Record):
    """A checklist item was ticked or unticked on a screen; all screens show the same ticks."""

    kind: Literal["item_ticked"] = "item_ticked"
    step: str
    attempt: int
    item: str
    ticked: bool


class RobotSeen(Record):
    """A person has looked at an arm whose connection was lost: it stands still, and nobody is within its reach."""

    kind: Literal["robot_seen"] = "robot_seen"
    device: str  # name in rig.yaml
    lost_seq: int = 0  # the event that reported the loss; 0: the program had ended, which no event had reported


class ControlTaken(Record):
    """One screen took control of the run: from now on only it may act on the run; the others may only watch."""

    kind: Literal["control_taken"] = "control_taken"
    screen: str  # name of the sign-in whose screen it is; "" when control was given back
    previous: str  # person who had control before; "" for nobody
    how: Literal["free", "handed_over", "taken_over"]
    reason: str = ""


class RecordCorrected(Record):
    """A value of an earlier event is corrected. The original stays, and readers see both."""

    kind: Literal["record_corrected"] = "record_corrected"
    of_seq: int
    field: str  # path in the payload: environment.light_lux
    old: Any
    new: Any
    reason: str


class RegionDrawn(Record):
    """A person drew a polygon on the 3D view in which one source of the ground truth counts; used by the next fusion.

    In the frame of the scan, metres; `seen_along` points from the surface to the viewer.
    """

    kind: Literal["region_drawn"] = "region_drawn"
    step: str  # whose next fusion uses it
    source: Literal["ct", "scan"]
    corners_m: tuple[tuple[float, float, float], ...]
    seen_along: tuple[float, float, float]


class RunReleased(Record):
    """A second person's signature that allows the export of a completed run."""

    kind: Literal["run_released"] = "run_released"
    meaning: str
    signed_sha256: str  # the hash of the run_completed event
    identified: Literal["", "claimed", "password"] = ""  # the way of identification; "" in older records


class EvidenceExported(Record):
    """A bundle, a data set or a report left the system."""

    kind: Literal["evidence_exported"] = "evidence_exported"
    what: Literal["bundle", "dataset", "report"]
    file_name: str
    sha256: str
    size_bytes: int
    head_sha256: str  # the chain's hash when it was made
