"""Preset reasons for a redo, a skip or an acceptance: typing in gloves is hard, and equal words can be counted."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from service.core.records.events import Record

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
    """The reason that is recorded: the chosen preset, then the operator's own words."""
    return ": ".join(part for part in (preset.strip(), own.strip()) if part)
