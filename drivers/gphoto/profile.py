"""What a profile of a camera states, and how the camera's words become a protocol's settings and back."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from types import MappingProxyType

from drivers.errors import DeviceRefusedError

RELATIVE_TOLERANCE = 0.01  # adjacent thirds of a stop differ by at least 12 %
_LOW_BATTERY = 0.05  # what the word Low counts as


def _no_words() -> Mapping[str, tuple[str, ...]]:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Widget:
    """One setting: the name of libgphoto2's widget, and the camera's words for a protocol's."""

    name: str
    words: Mapping[str, tuple[str, ...]] = field(default_factory=_no_words)  # ours: the camera's, best first
    by_hand: str = ""  # what a person does where software can never set it; "" if it can
    unknown: tuple[str, ...] = ()  # the camera's words for no value at all
    if_fixed: str = ""  # what a person does where the camera states no value, or keeps it from being set

    def candidates(self, wanted: str) -> tuple[str, ...]:
        """The camera's words that mean `wanted`, best first."""
        return self.words.get(wanted, (wanted,))

    def ours(self, word: str) -> str:
        """The protocol's word for one of the camera's; the camera's own if it has none."""
        return next((ours for ours, theirs in self.words.items() if word in theirs), word)


@dataclass(frozen=True, slots=True)
class Fixed:
    """A setting that stays the same during a run, and is set where the body has it and lets it be set."""

    name: str  # of libgphoto2's widget
    words: tuple[str, ...]  # the camera's, best first
    otherwise: str  # what goes wrong, and what a person does where software cannot set it
    # Whether it applies at all: not while the camera states one of these, which it does while it is not in question.
    not_in_question: tuple[str, ...] = ()
    needed: bool = False  # whether nothing may be captured without it

    def suits(self, word: str) -> bool:
        """Return whether nothing has to be changed."""
        return word in self.words or word in self.not_in_question


@dataclass(frozen=True, slots=True)
class Profile:
    """The configuration of a family of bodies by libgphoto2's names."""

    bodies: str  # for messages
    manufacturer: str  # how the camera's own name of its maker begins
    model: str  # pattern of the whole model name, as libgphoto2 reports it
    exif_make: str  # how the maker's name in its files begins
    f_number: Widget
    shutter: Widget
    iso: Widget
    focus: Widget
    quality: Widget
    white_balance: Widget
    floating_white_balance: tuple[str, ...]  # words with which each image gets a balance of its own
    fixed_white_balance: str  # what replaces them
    program: Widget
    manual_program: str  # its word for exposure that is set by hand
    target: Widget
    targets: Mapping[str, str]  # computer, card, both: the camera's word; the first is the default
    serial: str = "serialnumber"
    fixed: tuple[Fixed, ...] = ()
    may_miss_first: bool = False  # whether a body may release and take nothing for some seconds after it was opened
    files_missing: str = ""  # what to look at where fewer files arrive than the quality promises
    # Properties of the card slots, by libgphoto2's hexadecimal names: (state, shots left). A body without storage in
    # remote control tells its space only there.
    slots: tuple[tuple[str, str], ...] = ()
    no_card: str = ""  # the state of a slot without a card
    # Whether libgphoto2 answers with the value that it sent until the camera reports another one. What such a body
    # was sent counts as set only when its report has come, or a new connection has read it.
    echoes: bool = False

    def fits(self, manufacturer: str, model: str) -> bool:
        """Return whether this profile is for a body of this name."""
        return manufacturer.startswith(self.manufacturer) and re.fullmatch(self.model, model) is not None

    def floats(self, white_balance: str) -> bool:
        """Return whether the camera chooses the white balance of each image by itself."""
        return white_balance in self.floating_white_balance


def number_of(word: str) -> float | None:
    """Parse "f/22", "1/15", "32/10" or "100" as a number; None for Bulb, Auto ISO and the like."""
    try:
        return float(Fraction(word.removeprefix("f/").strip()))
    except (ValueError, ZeroDivisionError):
        return None


def is_number(word: str, wanted: float) -> bool:
    """Return whether a camera's word means this number."""
    number = number_of(word)
    return number is not None and abs(number - wanted) <= RELATIVE_TOLERANCE * wanted


def battery_fraction(word: str) -> float | None:
    """The charge of the battery from "87%" or "Low"; None if the camera does not say it.

    A Sony says -1 where it does not know, perhaps on mains power, which libgphoto2 writes as 253%.
    """
    number = number_of(word.rstrip("%"))
    if number is not None:
        return number / 100.0 if 0.0 <= number <= 100.0 else None
    return _LOW_BATTERY if word == "Low" else None


def choose_number(widget: Widget, wanted: float, offered: Sequence[str], where: str) -> str:
    """Return the offered word for a number. Raises DeviceRefusedError, which names the nearest offered values."""
    name = widget.name
    numbers = [(word, number) for word in offered if (number := number_of(word)) is not None]
    if not numbers:
        raise DeviceRefusedError(
            f"the camera offers no values for {name}",
            where=where,
            remedy=widget.if_fixed or "Turn the mode dial to M and check the lens",
        )
    numbers.sort(key=lambda pair: abs(pair[1] - wanted))
    word, number = numbers[0]
    if abs(number - wanted) > RELATIVE_TOLERANCE * wanted:
        near = f"Nearest that it offers: {', '.join(neighbour for neighbour, _ in numbers[:4])}"
        if len(numbers) == 1:  # as a Canon that chooses the value itself
            near = f"It offers only {word}. {widget.if_fixed or 'Turn the mode dial to M'}"
        raise DeviceRefusedError(f"the camera does not offer {name} {wanted:g}", where=where, remedy=near)
    return word


def choose_word(widget: Widget, wanted: str, offered: Sequence[str], where: str) -> str:
    """Return the offered word for a named setting. Raises DeviceRefusedError, which lists the offered ones."""
    for word in widget.candidates(wanted):
        if word in offered:
            return word
    raise DeviceRefusedError(
        f"the camera does not offer {widget.name} {wanted}",
        where=where,
        remedy=f"It offers: {', '.join(offered) or 'nothing'}",
    )


def quality_of(word: str) -> str:
    """Map a camera's own word for the files of an exposure to JPEG, RAW or RAW+JPEG."""
    if "+" in word:
        return "RAW+JPEG"
    return "RAW" if "RAW" in word.upper() else "JPEG"
