"""Options that describe a run: specimen, purpose, site, remarks."""

from __future__ import annotations

from typing import Annotated

import typer

SpecimenOption = Annotated[str, typer.Option("--specimen", help="What is captured: name or number of the specimen.")]
PurposeOption = Annotated[str, typer.Option("--purpose", help="What the run is for.")]
SiteOption = Annotated[str, typer.Option("--site", help="Where it takes place.")]
RemarksOption = Annotated[str, typer.Option("--remarks", help="Anything else for the record.")]
