"""Follows the controller's reports, hands motions over piece by piece, and latches whatever interrupts them."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from contextlib import suppress

import numpy as np

from drivers.arm.latch import Latch
from drivers.errors import DeviceBusyError, DeviceError, DeviceUnavailableError, LeaveNeededError, SafetyStopError
from drivers.grbl import LETTERS, GrblConfig
from drivers.grbl.link import Link, Sent
from drivers.grbl.motion import Motion
from drivers.grbl.setup import Setup
from drivers.grbl.wire import JOG_CANCEL, RESET, Alarm, Message, Refused, Status, Welcome
from drivers.interfaces import Array, SafetyState

_UNANSWERED = 3  # lines that fit into the controller's 128 bytes
_DRIVEN = ("Run", "Jog", "Home")
_STOOD_STILL = "the driver's process stood still, and the axes were stopped"
_DOOR = "A person must close the safety door, and then confirm"


class Mover:
    """The state of the axes as the reports tell it; `take` runs in the link's thread, the rest in the caller's."""

    def __init__(self, where: str, config: GrblConfig) -> None:
        self._where, self._config = where, config
        self.latch = Latch(where)
        self.indices = tuple(LETTERS.index(axis.letter) for axis in config.axes)
        self._link: Link | None = None
        self._setup: Setup | None = None
        self._motion: Motion | None = None
        self._sent: deque[Sent] = deque()  # pieces of it without an answer yet
        self._attended_s = self._beat_s = self._began_s = -math.inf
        self._locked = False  # the controller was in an alarm at its last report
        self._at_the_door = False  # it was stopped by the door at its last report
        self.newest: tuple[Status | None, float] = (None, -math.inf)  # and when it was asked for, monotonic
        self.position: Array | None = None  # machine coordinates, degrees and millimetres; None: none stated yet
        self._work_offset: tuple[float, ...] | None = None  # WCO as last stated, of all axes of the controller
        self.override = 1.0
        self.arrived_s = -math.inf  # when the report was asked for that showed the end of the last motion
        self.homed = False  # by this driver, and the position was not lost since
        self.resetting = False  # this driver resets and homes the controller
        self.interrupted = False  # the last motion ended early

    def connect(self, link: Link, setup: Setup) -> None:
        """Move over this link."""
        self._link, self._setup = link, setup

    def disconnect(self) -> None:
        """Forget the link, the motion and the permission to move."""
        self.latch.close()
        self._link = self._setup = self._motion = None
        self.newest = (None, -math.inf)
        self.position = self._work_offset = None
        self.homed = self.interrupted = self._locked = self._at_the_door = False

    # --- what the reports say ----------------------------------------------------------------------------

    @property
    def status(self) -> Status | None:
        """The newest report."""
        return self.newest[0]

    @property
    def moving(self) -> bool:
        """Return whether a motion is under way."""
        return self._motion is not None

    @property
    def _door_is_open(self) -> bool:
        """False also if it was closed again and only a person's confirmation is missing."""
        return self.status is not None and self.status.state == "Door" and self.status.substate != 0

    @property
    def driven(self) -> bool:
        """Return whether the controller drives the axes."""
        return self.status is not None and (self.status.state in _DRIVEN or self.status.state == "Hold")

    @property
    def safety(self) -> SafetyState:
        """An alarm is a fault, the door a safeguard; being locked because nothing was homed yet is neither."""
        state = self.status.state if self.status is not None else ""
        if state == "Door":
            return SafetyState.SAFEGUARD_STOP
        return SafetyState.FAULT if state == "Alarm" and self.latch.stop is not None else SafetyState.NORMAL

    @staticmethod
    def at_rest(status: Status) -> bool:
        """Return whether nothing moves in this report."""
        return status.state not in (*_DRIVEN, "Hold", "Door") or (status.state, status.substate) in (
            ("Hold", 0), ("Door", 0), ("Door", 1),
        )  # fmt: skip

    def take(self, message: Message, at_s: float) -> None:
        """Take a message of the controller and, during a motion, hand over its next piece."""
        match message:
            case Alarm():
                self._lose(f"an alarm: {message.words}", at_s)
            case Welcome():
                self.position = self._work_offset = None  # a reset clears some offsets
                if self._link is not None and not self.resetting:
                    self._lose("a reset of its controller", at_s)
            case Status():
                self._follow(message, at_s)
            case _:
                pass

    def _lose(self, what: str, at_s: float) -> None:
        self.homed = False
        self.interrupted = self.interrupted or self._motion is not None
        self._motion = None
        if self.status is not None:  # whatever it did before, it stands now, and may report nothing until a reset
            self.newest = (dataclasses.replace(self.status, state="Alarm", substate=0), self.newest[1])
        self.latch.see(SafetyState.FAULT, at_s, what)

    def _follow(self, status: Status, at_s: float) -> None:
        self.newest = (status, at_s)
        self.override = self.override if status.feed_override is None else status.feed_override
        self._work_offset = status.work_offset or self._work_offset
        self.position = self._machine_position(status)
        locked = status.state in ("Alarm", "Sleep")
        if locked and not self._locked and self.homed:  # an alarm whose line was lost
            self._lose("an alarm that its controller did not name", at_s)
        self._locked = locked
        opened = status.state == "Door" and not self._at_the_door
        self._at_the_door = status.state == "Door"
        if self._at_the_door:
            self.interrupted = self.interrupted or self._motion is not None
            self._motion = None
        if self._door_is_open or opened:  # it may have closed again since the last report
            self.latch.see(SafetyState.SAFEGUARD_STOP, at_s)
        if self._link is None:
            return
        if self._motion is not None and self.position is not None:
            self._feed(self._link, self._motion, status, self.position, at_s)
        elif self._motion is None and status.state == "Jog":
            # A line that was not parsed yet when its motion was cancelled jogs after all: cancel it too.
            with suppress(DeviceUnavailableError):  # the next call reports the dead line
                self._link.act(JOG_CANCEL)

    def _machine_position(self, status: Status) -> Array | None:
        """Machine coordinates (N,) of the axes in use; None while the offset of work coordinates is not known."""
        stated = status.position
        if stated is None and status.work_position is not None and self._work_offset is not None:
            stated = tuple(w + o for w, o in zip(status.work_position, self._work_offset, strict=False))
        if stated is None or max(self.indices) >= len(stated):  # an axis that is missing: the settings said so
            return None
        return np.array([stated[i] for i in self.indices])

    # --- motions -----------------------------------------------------------------------------------------

    def beat(self, sent_monotonic_s: float) -> None:
        """Note a sign of life of the program; one that waited in a queue does not count for longer."""
        self._beat_s = max(self._beat_s, sent_monotonic_s)

    def attend(self) -> None:
        """Note that somebody looks at the axes."""
        self._attended_s = time.monotonic()

    def refuse_while_door_is_open(self) -> None:
        """Raise SafetyStopError if the safety door is open."""
        if self._door_is_open:
            raise SafetyStopError("the safety door is open", where=self._where, remedy=_DOOR)

    def require_ready(self) -> None:
        """Raise what prevents a motion from beginning."""
        self.refuse_while_door_is_open()
        if hold := self.latch.hold:
            raise hold
        if not self.homed:
            remedy = "Look whether anybody is in reach; the axes are homed after a person has confirmed"
            raise LeaveNeededError("the position of the axes is not known", where=self._where, remedy=remedy)
        state = self.status.state if self.status is not None else "silent"
        if self.moving or state != "Idle":
            remedy = "Wait until the axes stand still"
            raise DeviceBusyError(f"the controller is {state}", where=self._where, remedy=remedy)

    def begin(self, target: Array, speeds: Array) -> None:
        """Start a motion to machine coordinates (N,), at most at `speeds` (N,), in units of each axis per second."""
        setup, position = self._setup, self.position
        if setup is None or position is None:
            raise DeviceUnavailableError("the axes are not connected", where=self._where, remedy="Open them first")
        way = np.abs(target - position)
        duration_s = float(np.max(way / speeds))
        self.interrupted = False
        if duration_s < 1e-4:  # nothing to move: the positions are rounded to 0.001
            return
        going = way > 0
        braking_s = float(np.max(way[going] / duration_s / setup.acceleration[going])) / 2
        letters = tuple(axis.letter for axis in self._config.axes)
        self.attend()
        self._began_s = self._attended_s
        self.beat(self._attended_s)
        self._sent.clear()
        self._motion = Motion(letters, position.copy(), target, duration_s, braking_s)

    def abandon(self) -> None:
        """Hand over no more of the motion."""
        self._motion = None

    def _feed(self, link: Link, motion: Motion, status: Status, position: Array, asked_s: float) -> None:
        now_s = time.monotonic()
        if lost := self._unsupervised(link, now_s):
            self._end(link, lost)
            return
        for sent in self._sent:
            if isinstance(sent.answer, Refused):
                self._end(link, f"the controller refused a part of the motion: {sent.answer.words}")
                return
        while self._sent and self._sent[0].answer is not None:
            self._sent.popleft()
        if status.state == "Idle" and link.misses_answer(self._config.answer_timeout_s):
            if not motion.all_sent:  # it stands, and must not move on by itself
                self._end(link, "the controller did not answer to a part of the motion")
                return
            link.forget_unanswered()
        if status.state == "Idle" and not link.unanswered and asked_s > link.answered_s:
            if not motion.stands_at_its_end(position):
                self._end(link, "somebody or something stopped the axes")
                return
            if motion.all_sent:
                self._motion, self.arrived_s = None, asked_s
                return
        try:
            while link.unanswered < _UNANSWERED and (piece := motion.next_piece(position)) is not None:
                self._sent.append(link.send(piece))
                # Suspended between the checks above and this line?
                if time.monotonic() - now_s > self._config.stood_still_s:
                    self._end(link, _STOOD_STILL)
                    return
        except DeviceError:
            self.interrupted, self._motion = True, None  # the next call reports the dead line
            # A line may have been written after all, but late, to axes that have come to rest.
            with suppress(DeviceUnavailableError):
                link.act(RESET)

    def _unsupervised(self, link: Link, now_s: float) -> str:
        if link.went_on_s > self._began_s:  # the axes came to rest meanwhile, and must not move on by themselves
            return _STOOD_STILL
        if now_s - self._beat_s > self._config.watchdog_s:
            return "the program gave no sign of life, and the axes were stopped"
        if now_s - self._attended_s > self._config.unattended_s:
            return f"the axes were stopped: nobody had looked at them for {self._config.unattended_s:g} s"
        return ""

    def _end(self, link: Link, why: str) -> None:
        self.interrupted, self._motion = True, None
        self.latch.end(why)
        with suppress(DeviceUnavailableError):  # it stands anyway when what was handed over is done
            link.act(JOG_CANCEL)
