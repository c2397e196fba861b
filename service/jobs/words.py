"""Words for the names that records use: what people read on screens, in terminals and reports."""

from __future__ import annotations

from collections.abc import Mapping

from service.jobs import job_kinds

# Beside those of the job kinds, which each kind declares.
_WORDS: Mapping[str, str] = {"ct": "CT series", "control_image": "images of the control spheres"}


def term(name: str) -> str:
    """Words for a name of the records: ct_surface → CT surface; an unknown one with spaces."""
    kind = job_kinds().get(name)
    return kind.words if kind is not None else _WORDS.get(name, name.replace("_", " "))
