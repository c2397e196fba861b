"""Words for names in the records, for pages, terminals and reports."""

from __future__ import annotations

from collections.abc import Mapping

from service.jobs import job_kinds

# Of names that are not job kinds; each job kind declares its own words.
_WORDS: Mapping[str, str] = {"ct": "CT series", "control_image": "images of the control spheres"}


def term(name: str) -> str:
    """Words for a name in the records: `CT surface` for ct_surface; an unknown name with spaces."""
    kind = job_kinds().get(name)
    return kind.words if kind is not None else _WORDS.get(name, name.replace("_", " "))
