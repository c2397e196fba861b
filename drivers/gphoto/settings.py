"""Translates a protocol's camera settings to the words that the camera's choice lists offer, and back."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from drivers.errors import DeviceRefusedError

F_NUMBER, SHUTTER, ISO, FOCUS, QUALITY, TARGET = (
    "f-number",
    "shutterspeed",
    "iso",
    "focusmode",
    "imagequality",
    "d222",
)
RELATIVE_TOLERANCE = 0.01  # adjacent thirds of a stop differ by at least 12 %
TARGET_CODES = {"computer": "1", "card": "16", "both": "17"}
# A camera in mode 2 offers the finer words instead of the plain ones.
_QUALITY_WORDS = {
    "JPEG": ("JPEG", "Extra Fine", "X.Fine", "Fine"),
    "RAW": ("RAW",),
    "RAW+JPEG": ("RAW+JPEG", "RAW+JPEG (X.Fine)", "RAW+JPEG (Fine)"),
}


def number_of(word: str) -> float | None:
    """Parse "f/22", "1/15", "32/10" or "100" as a number; None for Bulb, Auto ISO and the like."""
    try:
        return float(Fraction(word.removeprefix("f/").strip()))
    except (ValueError, ZeroDivisionError):
        return None


def choose_number(name: str, wanted: float, offered: Sequence[str], where: str) -> str:
    """Return the offered word for a number. Raises DeviceRefusedError, which names the nearest offered values."""
    numbers = [(word, number) for word in offered if (number := number_of(word)) is not None]
    if not numbers:
        raise DeviceRefusedError(
            f"The camera offers no values for {name}",
            where=where,
            remedy="Turn the mode dial to M and check the lens",
        )
    numbers.sort(key=lambda pair: abs(pair[1] - wanted))
    word, number = numbers[0]
    if abs(number - wanted) > RELATIVE_TOLERANCE * wanted:
        near = ", ".join(neighbour for neighbour, _ in numbers[:4])
        raise DeviceRefusedError(
            f"The camera does not offer {name} {wanted:g}", where=where, remedy=f"Nearest that it offers: {near}"
        )
    return word


def choose_word(name: str, wanted: str, offered: Sequence[str], where: str) -> str:
    """Return the offered word for a named setting. Raises DeviceRefusedError, which lists the offered ones."""
    for word in _QUALITY_WORDS.get(wanted, (wanted,)) if name == QUALITY else (wanted,):
        if word in offered:
            return word
    raise DeviceRefusedError(
        f"The camera does not offer {name} {wanted}",
        where=where,
        remedy=f"It offers: {', '.join(offered) or 'nothing'}",
    )


def quality_of(word: str) -> str:
    """Map the camera's own word for image quality to JPEG, RAW or RAW+JPEG."""
    if word.startswith("RAW+"):
        return "RAW+JPEG"
    return "RAW" if word.startswith("RAW") else "JPEG"
