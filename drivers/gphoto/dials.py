"""The settings of an open camera: each is written by itself, read back from the camera, and tried again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator

from drivers.errors import DeviceBusyError, DeviceError, DeviceRefusedError, DeviceUnavailableError
from drivers.gphoto.link import AddedFile, Link
from drivers.gphoto.profile import (
    Fixed,
    Profile,
    Widget,
    choose_number,
    choose_word,
    is_number,
    number_of,
    quality_of,
)
from drivers.interfaces import CameraSettings

_LOG = logging.getLogger(__name__)
SET_ATTEMPTS = 3
READ_BACK_TIMEOUT_S = 2.0
REFUSED_PATIENCE_S = 0.2
NOT_TOLD = "not stated"


class Dials:
    """The settings of one camera by its profile. `announced` collects files whose announcement came in between."""

    def __init__(self, link: Link, profile: Profile, white_balance: str) -> None:
        self._link = link
        self._profile = profile
        self._white_balance = white_balance
        self._refused: set[str] = set()  # what the camera says that it can set, and does not
        self.announced: list[AddedFile] = []

    def serial(self) -> str:
        """The body's serial number, without leading zeros.

        It is one of the first things that a body tells: without it the connection is none, whatever libgphoto2 says,
        and DeviceUnavailableError is raised.
        """
        try:
            return self._link.value(self._profile.serial).lstrip("0")
        except DeviceRefusedError as error:
            raise DeviceUnavailableError(
                f"the camera connects and then does not tell its settings: {error.what}",
                where=self._link.where,
                remedy="Check cable and power, then open the camera again; switch it off and on if need be",
            ) from error

    def refresh(self) -> None:
        """Drain events, so that values are read afresh."""
        self.announced += self._link.refresh()

    def lock(self) -> None:
        """Set what never changes during a run: the white balance, if it would float, and the profile's fixed words.

        Raises DeviceRefusedError if the camera does not offer or keep one.
        """
        profile, where = self._profile, self._link.where
        now = self._now(profile.white_balance.name)
        wanted = self._white_balance or (profile.fixed_white_balance if profile.floats(now) else now)
        if wanted != now:
            offered = self._link.choices(profile.white_balance.name)
            self.set(profile.white_balance.name, choose_word(profile.white_balance, wanted, offered, where))
        for fixed, now in self._differences():
            if fixed.needed:
                self.set(fixed.name, fixed.words[0], fixed.otherwise)
                continue
            try:
                if self._can_be_set(fixed):
                    self.set(fixed.name, fixed.words[0])
                    continue
            except DeviceRefusedError as error:
                self._refused.add(fixed.name)
                _LOG.warning("%s", error)
            _LOG.warning("%s is %s, and the camera does not let it be set: %s", fixed.name, now, fixed.otherwise)

    def _differences(self) -> Iterator[tuple[Fixed, str]]:
        """Yield what the profile fixes and the body has otherwise, with the body's word."""
        names = self._link.names() if self._profile.fixed else frozenset[str]()
        for fixed in (one for one in self._profile.fixed if one.name in names):
            try:
                now = self._link.value(fixed.name)
            except DeviceRefusedError:
                now = NOT_TOLD
            if not fixed.suits(now):
                yield fixed, now

    def _can_be_set(self, fixed: Fixed) -> bool:
        try:
            if fixed.name in self._refused or self._link.is_fixed(fixed.name):
                return False
            return fixed.words[0] in self._link.choices(fixed.name)
        except DeviceRefusedError:  # the body lists it and does not tell it
            return False

    def wrong_by_hand(self) -> tuple[str, ...]:
        """Return what the body has otherwise than the profile fixes it and software cannot set, as sentences."""
        return tuple(
            f"{fixed.name} is {now}: {fixed.otherwise}"
            for fixed, now in self._differences()
            if not self._can_be_set(fixed)
        )

    def word(self, widget: Widget) -> str:
        """The camera's word for a setting. Raises DeviceRefusedError if it has or states none."""
        try:
            word = self._link.value(widget.name)
        except DeviceRefusedError as error:
            if not widget.if_fixed:
                raise
            raise DeviceRefusedError(error.what, where=self._link.where, remedy=widget.if_fixed) from error
        if word in widget.unknown:
            raise DeviceRefusedError(
                f"the camera states no {widget.name} ({word})", where=self._link.where, remedy=widget.if_fixed
            )
        return word

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set each value to one that the camera currently offers, and return what reads back.

        Raises DeviceRefusedError if the camera does not offer a value or does not keep it.
        """
        profile = self._profile
        self.refresh()
        self._apply_word(profile.quality, settings.image_quality)
        self._apply_word(profile.focus, settings.focus_mode)
        self._apply_number(profile.f_number, settings.aperture_f)
        self._apply_number(profile.shutter, settings.exposure_s)
        self._apply_number(profile.iso, float(settings.iso))
        self.lock()
        return self.settings()

    def settings(self) -> CameraSettings:
        """Return the current settings; drains events first, which clears libgphoto2's 2 s cache."""
        profile = self._profile
        self.refresh()
        return CameraSettings(
            aperture_f=self._number(profile.f_number),
            exposure_s=self.exposure_s(),
            iso=round(self._number(profile.iso)),
            focus_mode=self.focus(),
            image_quality=self.quality(),
        )

    def exposure_s(self) -> float:
        """The exposure time, as last read."""
        return self._number(self._profile.shutter)

    def focus(self) -> str:
        """The focus mode in a protocol's words, as last read."""
        return self._profile.focus.ours(self.word(self._profile.focus))

    def quality(self) -> str:
        """JPEG, RAW or RAW+JPEG, as last read."""
        return quality_of(self.word(self._profile.quality))

    def _number(self, widget: Widget) -> float:
        word = self.word(widget)
        number = number_of(word)
        if number is None:
            raise DeviceRefusedError(
                f"the camera reports {widget.name} {word!r}, which is not a number",
                where=self._link.where,
                remedy=widget.if_fixed or "Turn the mode dial to M; check that the lens is locked in place",
            )
        return number

    def _apply_number(self, widget: Widget, wanted: float) -> None:
        now = self._now(widget.name)
        if now in widget.unknown:
            self.word(widget)  # says what is missing
        if is_number(now, wanted):
            return
        if not self._is_fixed_at(widget, lambda word: is_number(word, wanted), f"{wanted:g}"):
            offered = self._link.choices(widget.name)
            self.set(widget.name, choose_number(widget, wanted, offered, self._link.where), widget.if_fixed)

    def _is_fixed_at(self, widget: Widget, means: Callable[[str], bool], wanted: str) -> bool:
        """Return whether the camera keeps a setting from being changed, and it already has the wanted value.

        Raises DeviceRefusedError if it has another one.
        """
        try:
            if not self._link.is_fixed(widget.name):
                return False
        except DeviceRefusedError:
            self.word(widget)  # says what is missing
            raise
        self.refresh()  # the camera may have changed its mind since it was last asked
        now = self.word(widget)
        if not self._link.is_fixed(widget.name):
            return False
        if means(now):
            return True
        raise DeviceRefusedError(
            f"the camera keeps {widget.name} at {now} instead of {wanted}, and says that it cannot be set now",
            where=self._link.where,
            remedy=widget.if_fixed or "Turn the mode dial to M and check what the camera's menu allows",
        )

    def _apply_word(self, widget: Widget, wanted: str) -> None:
        now = self.word(widget)
        if widget.by_hand and now not in widget.candidates(wanted):
            raise DeviceRefusedError(
                f"the camera has {widget.name} {now} where {wanted} is needed",
                where=self._link.where,
                remedy=widget.by_hand,
            )
        if widget.by_hand or self._is_fixed_at(widget, lambda word: word in widget.candidates(wanted), wanted):
            return
        word = choose_word(widget, wanted, self._link.choices(widget.name), self._link.where)
        self.set(widget.name, word, widget.if_fixed)

    def set(self, name: str, word: str, remedy: str = "") -> None:
        """Set one widget and read it back. Raises DeviceRefusedError if the camera keeps another value."""
        refusal: DeviceError | None = None
        for _ in range(SET_ATTEMPTS):
            if self._now(name) == word:
                return
            self.refresh()  # what the camera reported before does not count
            self._link.reported.clear()
            refusal = None
            try:
                self._link.put(name, word)
            except (DeviceRefusedError, DeviceBusyError, DeviceUnavailableError) as error:
                # A refusal and a lost link both give -1: reading back shows which it was.
                refusal = error
            # What the camera has refused in words does not change by itself a moment later.
            patience_s = REFUSED_PATIENCE_S if isinstance(refusal, DeviceRefusedError) else READ_BACK_TIMEOUT_S
            if self._reads_back(name, word, patience_s):
                return
        now = self._now(name)
        raise DeviceRefusedError(
            f"the camera keeps {name} at {now} instead of {word}",
            where=self._link.where,
            remedy=remedy or "Turn the mode dial to M and check what the camera's menu allows in this mode",
        ) from refusal

    def _now(self, name: str) -> str:
        """The camera's word; NOT_TOLD where it states none yet, which does not keep it from being set."""
        try:
            return self._link.value(name)
        except DeviceRefusedError:
            return NOT_TOLD

    def _reads_back(self, name: str, word: str, patience_s: float) -> bool:
        deadline = time.monotonic() + patience_s
        by_itself = self._profile.echoes and name != self._profile.target.name
        while True:
            self.refresh()
            if self._now(name) == word and (not by_itself or name in self._link.reported):
                return True
            if time.monotonic() > deadline:
                break
            time.sleep(0.1)
        if not by_itself or self._now(name) != word:
            return False
        # The value is what was sent and the camera has not reported it: a new connection asks the camera.
        self._link.open()
        return self._now(name) == word
