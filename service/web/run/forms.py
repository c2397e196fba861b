"""The forms by which people act on a run, and the page that follows them."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Form, Path
from fastapi.responses import RedirectResponse
from pydantic import BaseModel, Field

from service.core.records.events import OperatorVerb
from service.core.text.words import REASON_CHARACTERS
from service.people.sessions import KnownBy

RunId = Annotated[str, Path(max_length=64)]
Reason = Annotated[str, Form(max_length=REASON_CHARACTERS)]


class StartForm(BaseModel):
    """What a run is begun with: a protocol file, and what people enter about the run, of which it needs the specimen.

    A protocol whose content was changed without a new version also needs a reason and a password.
    """

    protocol: str = Field(max_length=200)
    reason: str = Field("", max_length=REASON_CHARACTERS)
    password: str = Field("", max_length=1000)
    specimen: str = Field("", max_length=2000)
    purpose: str = Field("", max_length=2000)
    site: str = Field("", max_length=2000)
    operator: str = Field("", max_length=2000)
    text: str = Field("", max_length=20_000)


class ActionForm(BaseModel):
    """An action on a run.

    Attributes:
        verb: the action.
        step: identifier of the step; "" for the current one.
        current: the step at which the run was, as the page showed it; a redo is of another one.
        attempt: of that step, as the page showed it.
        viewpoint: that is redone; "" for the whole step.
        replaces: number of the event whose image of the viewpoint the page said is replaced; 0 for none.
        moves: whether the page said that the robot then drives there at once.
        preset: a reason chosen from the list.
        reason: words that are added to it.
        meaning: what a signature stands for.
        known_by: what `password` holds: the password, or a PIN or badge where the site allows them for signatures.
        password: see `known_by`.
        account: of the person who accepts, where that is not the person who is signed in.
        signed_sha256: hash of the record that a signature or acceptance binds.
        seen_seq: number of the last event that the page showed.
        back: page to return to; "" for the run's page.
    """

    verb: OperatorVerb
    step: str = Field("", max_length=200)
    current: str = Field("", max_length=200)
    attempt: int = Field(0, ge=0, le=2**31)
    viewpoint: str = Field("", max_length=200)
    replaces: int = Field(0, ge=0, le=2**31)
    moves: bool = False
    preset: str = Field("", max_length=2000)
    reason: str = Field("", max_length=REASON_CHARACTERS)
    meaning: str = Field("", max_length=2000)
    known_by: KnownBy = "password"
    password: str = Field("", max_length=1000)
    account: str = Field("", max_length=200)
    signed_sha256: str = Field("", max_length=200)
    seen_seq: int = Field(0, ge=0, le=2**31)
    back: Literal["", "capture"] = ""


def back_to(run_id: str, page: str = "") -> RedirectResponse:
    """Show a page of a run after a form was sent; "" is the run's own page."""
    return RedirectResponse(f"/runs/{run_id}/{page}".rstrip("/"), status_code=303)
