"""Room for photographs in a camera: the storage that libgphoto2 lists, or what the body says of its card slots."""

from __future__ import annotations

from drivers.errors import DeviceRefusedError, DeviceStorageFullError
from drivers.gphoto.link import Link
from drivers.gphoto.profile import Profile, number_of
from service.core.units import megabytes

LEAST_FREE_BYTES = 200_000_000  # room for one RAW+JPEG exposure of 61 megapixels


class Room:
    """Holds what the camera says of its memory and its cards, for files that are kept on `target`."""

    def __init__(self, link: Link, profile: Profile, target: str) -> None:
        self._link, self._profile, self._target = link, profile, target

    def free_bytes(self) -> int | None:
        """Free space of the camera's storage; None if it lists none, as a Sony in PC Remote mode."""
        try:
            return self._link.free_bytes()
        except DeviceRefusedError:
            return None

    def problem(self, free_bytes: int | None, *, refused: bool = False) -> str:
        """Return what is wrong with the space, as a sentence without a full stop; "" if enough or not known.

        A full card also counts if the files go to the computer and the camera has `refused` to release.
        """
        if free_bytes is not None:
            if free_bytes < LEAST_FREE_BYTES:
                return f"{megabytes(free_bytes):.0f} MB free in the camera"
        elif (self._target != "computer" or refused) and (slots := self._slots()):
            cards = [shots for state, shots in slots if state != self._profile.no_card]
            if cards and not sum(cards):
                return "the camera says that no photograph fits on its card"
            if not cards and self._target != "computer":
                return "there is no card in the camera"
        return ""

    def check(self, *, refused: bool = False) -> None:
        """Raise DeviceStorageFullError if the camera says that the next exposure does not fit, or did not."""
        free_bytes = self.free_bytes()
        if self._target == "computer" and free_bytes:
            return  # it is fetched and leaves its memory
        if problem := self.problem(free_bytes, refused=refused):
            raise DeviceStorageFullError(problem, where=self._link.where, remedy="Empty, change or insert the card")

    def _slots(self) -> list[tuple[str, int]]:
        """State of each card slot that the body has, and how many photographs fit on its card."""
        found: list[tuple[str, int]] = []
        for state, shots in self._profile.slots:
            try:
                number = number_of(self._link.value(shots))
                found.append((self._link.value(state), round(number or 0)))
            except DeviceRefusedError:
                continue
        return found
