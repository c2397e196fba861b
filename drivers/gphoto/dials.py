"""The settings of an open camera: each is written by itself, read back from the camera, and tried again."""

from __future__ import annotations

import time

from drivers.errors import DeviceBusyError, DeviceError, DeviceRefusedError, DeviceUnavailableError
from drivers.gphoto.link import AddedFile, Link
from drivers.gphoto.profile import Profile, Widget, choose_number, choose_word, number_of, quality_of
from drivers.interfaces import CameraSettings

SET_ATTEMPTS = 3
READ_BACK_TIMEOUT_S = 2.0


class Dials:
    """The settings of one camera by its profile. `announced` collects files whose announcement came in between."""

    def __init__(self, link: Link, profile: Profile, white_balance: str) -> None:
        self._link = link
        self._profile = profile
        self._white_balance = white_balance
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
        now = self._link.value(profile.white_balance.name)
        wanted = self._white_balance or (profile.fixed_white_balance if profile.floats(now) else now)
        if wanted != now:
            offered = self._link.choices(profile.white_balance.name)
            self.set(profile.white_balance.name, choose_word(profile.white_balance, wanted, offered, where))
        names = self._link.names() if profile.fixed else frozenset[str]()
        for name, word in profile.fixed:
            if name in names:
                self.set(name, word)

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
        return self._profile.focus.ours(self._link.value(self._profile.focus.name))

    def quality(self) -> str:
        """JPEG, RAW or RAW+JPEG, as last read."""
        return quality_of(self._link.value(self._profile.quality.name))

    def _number(self, widget: Widget) -> float:
        word = self._link.value(widget.name)
        number = number_of(word)
        if number is None:
            raise DeviceRefusedError(
                f"the camera reports {widget.name} {word!r}, which is not a number",
                where=self._link.where,
                remedy="Turn the mode dial to M; check that the lens is locked in place",
            )
        return number

    def _apply_number(self, widget: Widget, wanted: float) -> None:
        offered = self._link.choices(widget.name)
        self.set(widget.name, choose_number(widget, wanted, offered, self._link.where))

    def _apply_word(self, widget: Widget, wanted: str) -> None:
        now = self._link.value(widget.name)
        if widget.by_hand and now not in widget.candidates(wanted):
            raise DeviceRefusedError(
                f"the camera has {widget.name} {now} where {wanted} is needed",
                where=self._link.where,
                remedy=widget.by_hand,
            )
        if not widget.by_hand:
            self.set(widget.name, choose_word(widget, wanted, self._link.choices(widget.name), self._link.where))

    def set(self, name: str, word: str) -> None:
        """Set one widget and read it back. Raises DeviceRefusedError if the camera keeps another value."""
        refusal: DeviceError | None = None
        for _ in range(SET_ATTEMPTS):
            if self._link.value(name) == word:
                return
            self.refresh()  # what the camera reported before does not count
            self._link.reported.clear()
            try:
                self._link.put(name, word)
            except (DeviceRefusedError, DeviceBusyError, DeviceUnavailableError) as error:
                # A refusal and a lost link both give -1: reading back shows which it was.
                refusal = error
            if self._reads_back(name, word):
                return
        now = self._link.value(name)
        raise DeviceRefusedError(
            f"the camera keeps {name} at {now} instead of {word}",
            where=self._link.where,
            remedy="Turn the mode dial to M and check what the camera's menu allows in this mode",
        ) from refusal

    def _reads_back(self, name: str, word: str) -> bool:
        deadline = time.monotonic() + READ_BACK_TIMEOUT_S
        by_itself = self._profile.echoes and name != self._profile.target.name
        while True:
            self.refresh()
            if self._link.value(name) == word and (not by_itself or name in self._link.reported):
                return True
            if time.monotonic() > deadline:
                break
            time.sleep(0.1)
        if not by_itself or self._link.value(name) != word:
            return False
        # The value is what was sent and the camera has not reported it: a new connection asks the camera.
        self._link.open()
        return self._link.value(name) == word
