"""What people say about a data set: what the record of a run cannot know."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from pydantic import Field

from service.core.errors import DataError
from service.core.records.attribution import doi_address, licence_address, party
from service.core.records.base import Record

FIRST_VERSION = "1.0.0"
VERSION = r"^\d{1,6}\.\d{1,6}\.\d{1,6}$"  # of a data set: MAJOR.MINOR.PATCH
LONGEST_NAME = 200  # of a creator, characters
_Name = Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)]
_Line = Annotated[str, Field(max_length=1000)]


class DataSetStatement(Record):
    """What an exported data set says about itself; what is left out is said to be not stated."""

    title: _Line = ""  # of the data set; without it, the protocol's title and the specimen
    licence: _Line = ""  # SPDX identifier such as CC-BY-4.0, or the licence's address
    ethics: _Line = ""  # approval or waiver, with its number and the body that gave it
    # People, each with an ORCID if possible, or bodies, with a ROR: "Rivera, Ana 0000-0002-1825-0097".
    creators: tuple[_Name, ...] = ()
    cite: _Line = ""  # how the data set should be cited
    doi: _Line = ""  # of this data set, such as 10.5281/zenodo.1234567
    publisher: _Line = ""  # the body that publishes it, with its ROR if possible
    funders: tuple[_Name, ...] = ()  # bodies that paid for it, each with its ROR if possible

    def or_else(self, other: DataSetStatement) -> DataSetStatement:
        """This statement, with what it leaves out taken from another."""
        return DataSetStatement(
            title=self.title or other.title,
            licence=self.licence or other.licence,
            ethics=self.ethics or other.ethics,
            creators=self.creators or other.creators,
            cite=self.cite or other.cite,
            doi=self.doi or other.doi,
            publisher=self.publisher or other.publisher,
            funders=self.funders or other.funders,
        )

    def problems(self) -> dict[tuple[str | int, ...], DataError]:
        """Which identifiers are wrong, by field and index. Old records are read nonetheless, new ones refused."""
        found: dict[tuple[str | int, ...], DataError] = {}
        checks: tuple[tuple[tuple[str | int, ...], Callable[[str], object], str], ...] = (
            (("licence",), licence_address, self.licence),
            (("doi",), doi_address, self.doi),
            *((("creators", k), party, name) for k, name in enumerate(self.creators)),
            *((("publisher",), party, name) for name in (self.publisher,) if name),
            *((("funders", k), party, name) for k, name in enumerate(self.funders)),
        )
        for field, read, text in checks:
            try:
                read(text)
            except DataError as error:
                found[field] = error
        return found
