"""What people say about a data set: what the record of a run cannot know."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from service.core.records.base import Record

FIRST_VERSION = "1.0.0"
VERSION = r"^\d{1,6}\.\d{1,6}\.\d{1,6}$"  # of a data set: MAJOR.MINOR.PATCH
LONGEST_NAME = 200  # of a creator, characters
_Line = Annotated[str, Field(max_length=1000)]


class DataSetStatement(Record):
    """What an exported data set says about itself; what is left out is said to be not stated."""

    title: _Line = ""  # of the data set; without it, the protocol's title and the specimen
    licence: _Line = ""  # SPDX identifier such as CC-BY-4.0, or the licence's address
    ethics: _Line = ""  # approval or waiver, with its number and the body that gave it
    creators: tuple[Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)], ...] = ()  # people or bodies
    cite: _Line = ""  # how the data set should be cited

    def or_else(self, other: DataSetStatement) -> DataSetStatement:
        """This statement, with what it leaves out taken from another."""
        return DataSetStatement(
            title=self.title or other.title,
            licence=self.licence or other.licence,
            ethics=self.ethics or other.ethics,
            creators=self.creators or other.creators,
            cite=self.cite or other.cite,
        )
