"""What events do to what is known of the connections to the arms, and to the leave to move."""

from __future__ import annotations

from dataclasses import replace

from service.core.errors import what_of
from service.core.protocol.models import Protocol
from service.core.records.events import DeviceOpened, DeviceTrouble, Event, LeaveLapsed, RobotSeen
from service.core.run.connections import ENDINGS, NO_ARM, ArmConnection, Loss
from service.core.run.effects.place import without_effect
from service.core.run.state import Lapse, RunState, Trouble
from service.core.run.state_transitions import wait


def device_opened(protocol: Protocol, state: RunState, event: Event, p: DeviceOpened) -> RunState:
    """An arm is connected; that does not say that anybody has looked at it since its last connection was lost."""
    identity = p.report.get("identity")
    if not isinstance(identity, dict) or identity.get("kind") != "robot":
        return state
    arm = state.arms.get(p.device, NO_ARM)
    return with_arm(state, p.device, replace(arm, connected=True, refused_utc="", refused_why=""))


def device_trouble(protocol: Protocol, state: RunState, event: Event, p: DeviceTrouble) -> RunState:
    """List a device's trouble; an arm whose connection ended with it counts as moving."""
    state = replace(state, troubles=(*state.troubles, Trouble(event.seq, p.device, p.error, p.message)))
    if not p.connection:
        return state
    arm = state.arms.get(p.device, NO_ARM)
    if p.connection == "refused":
        refused = replace(arm, connected=False, refused_utc=event.at_utc, refused_why=what_of(p.message))
        return with_arm(state, p.device, refused)
    why = what_of(p.message)
    how = f"{ENDINGS[p.connection]} ({why.rpartition(': ')[2] if p.connection == 'died' else why})"
    return with_arm(state, p.device, lost(arm, event.seq, event.at_utc, how))


def lost(arm: ArmConnection, seq: int, at_utc: str, how: str) -> ArmConnection:
    """An arm whose connection was lost, since the first loss that nobody has looked at."""
    since_utc = at_utc if arm.loss is None else arm.loss.since_utc
    return replace(arm, connected=False, loss=Loss(seq, since_utc, how), lost_utc=at_utc, seen_by="", seen_utc="")


def connections_ended(state: RunState, event: Event) -> RunState:
    """The program that drove the run has ended, and with it its connections, at some time after the last event."""
    arms = {
        name: lost(arm, event.seq, state.at_utc, ENDINGS["program"]) if arm.connected else arm
        for name, arm in state.arms.items()
    }
    return replace(state, arms=arms) if arms != state.arms else state


def robot_seen(protocol: Protocol, state: RunState, event: Event, p: RobotSeen) -> RunState:
    """A person has looked at an arm; without effect if its connection was lost again since the page was shown."""
    arm = state.arms.get(p.device)
    answered = arm is not None and (p.lost_seq == 0 if arm.loss is None else p.lost_seq == arm.loss.seq)
    if arm is None or not answered:
        return without_effect(state, event)
    lost_utc = arm.lost_utc if arm.loss is not None else state.at_utc
    seen = replace(arm, loss=None, lost_utc=lost_utc, seen_by=event.actor, seen_utc=event.at_utc)
    # Without a recorded loss it was the program that had ended, and with it the connection.
    return with_arm(state, p.device, seen if p.lost_seq else replace(seen, connected=False))


def all_seen(state: RunState, event: Event) -> RunState:
    """Whoever lets the robot move has looked at it: the question asks for that."""
    arms = {
        name: replace(arm, loss=None, seen_by=event.actor, seen_utc=event.at_utc) if arm.loss is not None else arm
        for name, arm in state.arms.items()
    }
    return replace(state, arms=arms) if arms != state.arms else state


def leave_lapsed(protocol: Protocol, state: RunState, event: Event, p: LeaveLapsed) -> RunState:
    """The leave to move is over; without effect if a person has given another one meanwhile."""
    if state.leave is None or state.leave.seq != p.leave_seq:
        return without_effect(state, event)
    lapse = Lapse(event.seq, state.leave.by, p.idle_s, p.limit_s, p.why)
    return wait(protocol, replace(state, leave=None, lapse=lapse), event)


def with_arm(state: RunState, name: str, arm: ArmConnection) -> RunState:
    """The state with another record of one arm."""
    return replace(state, arms={**state.arms, name: arm})
