"""Options that describe a run: specimen, purpose, site, remarks."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from service.core.records.entered import RunAbout, about_run, require_specimen

SpecimenOption = Annotated[
    str,
    typer.Option("--specimen", help="What is captured: name or number of the specimen, which a person must give."),
]
PurposeOption = Annotated[str, typer.Option("--purpose", help="What the run is for.")]
SiteOption = Annotated[str, typer.Option("--site", help="Where it takes place.")]
RemarksOption = Annotated[str, typer.Option("--remarks", help="Anything else for the record.")]


def described(specimen: str, *, purpose: str, site: str, remarks: str) -> RunAbout:
    """What a person enters about a run; in a terminal a specimen that is not given is asked for.

    Raises ConfigurationError if it is not named, or a text is too long.
    """
    if not specimen.strip() and sys.stdin.isatty():
        specimen = typer.prompt("Specimen, name or number", default="", show_default=False, err=True)
    about = about_run(specimen=specimen, purpose=purpose, site=site, text=remarks)
    require_specimen(about)
    return about
