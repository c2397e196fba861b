"""What a reason is, wherever a person has to give one."""

from __future__ import annotations

from service.core.errors import OrthocaptureError

REASON_CHARACTERS = 2000


def reason_of(typed: str, error: type[OrthocaptureError]) -> str:
    """The reason without outer blanks. Raises this error if it says nothing, or more than anybody reads."""
    plain = typed.strip()
    if not plain or len(plain) > REASON_CHARACTERS:
        raise error(
            f"the reason has {len(plain)} characters" if plain else "a reason is needed",
            where="reason",
            remedy=f"Say why, in up to {REASON_CHARACTERS} characters; it goes into the record",
        )
    return plain
