"""What people say about a data set: what the record of a run cannot know, such as who made it and its licence."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from service.core.errors import DataError
from service.core.records.base import Record

_ORCID = re.compile(r"\(?(?:https?://orcid\.org/|orcid:\s*)?(\d{4}-?\d{4}-?\d{4}-?\d{3}[\dXx])/?\)?", re.IGNORECASE)
_ROR = re.compile(
    r"\(?(?:https?://)?(?:ror\.org/([0-9a-z]*)|\b(0[a-hj-km-np-tv-z0-9]{6}\d{2})\b)/?\)?", re.IGNORECASE
)
_ROR_FORM = re.compile(r"0[a-hj-km-np-tv-z0-9]{6}\d{2}")
_ROR_DIGITS = "0123456789abcdefghjkmnpqrstvwxyz"  # Crockford's base 32
_DOI = re.compile(r"(?:https?://(?:dx\.)?doi\.org/|doi:\s*)?(10\.\d{4,9}/\S+)", re.IGNORECASE)
_MARKED = re.compile(r"(person|organi[sz]ation)\s*:\s*(.*)", re.IGNORECASE | re.DOTALL)
# Words in the names of bodies; of a name with none of them, nor an identifier, a person is the likelier bearer.
_BODY = re.compile(
    r"\b(universit\w*|institut\w*|hospital\w*|klinik\w*|spital\w*|clinic\w*|hôpital|ospedale|department|departement|"
    r"faculty|fakultät|hochschule|laborator\w*|cent(re|er)|zentrum|foundation|stiftung|society|association|academy|"
    r"akademie|agency|ministry|council|consortium|company|museum|library)(?!\w)",
    re.IGNORECASE,
)
_BODY_IN_SHORT = re.compile(r"\b(GmbH|AG|SA|Inc|Ltd|LLC|ETH|EPFL|Dept|School|College|Lab|Group|Team|Project)(?!\w)")
_CREATIVE_COMMONS = re.compile(r"CC-BY(-NC)?(-ND|-SA)?-(1\.0|2\.0|2\.5|3\.0|4\.0)(-[A-Z]{2,3})?")
# SPDX identifiers of other licences that data, documents and programs have.
_LICENCES = (
    "CC0-1.0", "CC-PDDC", "PDDL-1.0", "ODC-By-1.0", "ODbL-1.0", "CDLA-Permissive-1.0", "CDLA-Permissive-2.0",
    "CDLA-Sharing-1.0", "C-UDA-1.0", "DL-DE-BY-2.0", "DL-DE-ZERO-2.0", "etalab-2.0", "OGL-UK-3.0", "NLOD-2.0",
    "O-UDA-1.0", "GFDL-1.3-only", "GFDL-1.3-or-later", "LAL-1.3", "Unlicense", "MIT", "MIT-0", "ISC", "0BSD",
    "BSD-2-Clause", "BSD-3-Clause", "Apache-2.0", "MPL-2.0", "EUPL-1.2", "LGPL-2.1-only", "LGPL-2.1-or-later",
    "LGPL-3.0-only", "LGPL-3.0-or-later", "GPL-2.0-only", "GPL-2.0-or-later", "GPL-3.0-only", "GPL-3.0-or-later",
    "AGPL-3.0-only", "AGPL-3.0-or-later", "CERN-OHL-P-2.0", "CERN-OHL-W-2.0", "CERN-OHL-S-2.0",
)  # fmt: skip
_SPDX = "https://spdx.org/licenses/"


@dataclass(frozen=True, slots=True)
class Party:
    """A person or a body.

    Attributes:
        name: the name as it was given, without the identifier.
        kind: schema.org's name for a person or a body.
        address: the address of its ORCID or ROR; "" if none was given.
    """

    name: str
    kind: Literal["Person", "Organization"]
    address: str = ""

    @property
    def words(self) -> str:
        """The name, with the address behind it."""
        return f"{self.name} ({self.address})" if self.address else self.name


def party(text: str, *, otherwise: Literal["Person", "Organization", ""] = "") -> Party:
    """Return a person or body from a line: its name, and an ORCID or a ROR if it has one.

    `person: NAME` or `organisation: NAME` says which it is where neither is given and the name does not show it.
    `otherwise` is what it is where nothing says it; "": as the name sounds.

    Raises:
        DataError: the identifier is mistyped, or belongs to the other kind; or there is no name.
    """
    marked = _MARKED.fullmatch(text.strip())
    rest = marked[2] if marked is not None else text
    said: Literal["Person", "Organization", ""] = ""
    if marked is not None:
        said = "Person" if marked[1].lower() == "person" else "Organization"
    address = ""
    shown: Literal["Person", "Organization", ""] = ""
    if (found := _ROR.search(rest)) is not None:
        address, shown = f"https://ror.org/{_checked_ror(found[1] or found[2] or '')}", "Organization"
    elif (found := _ORCID.search(rest)) is not None:
        address, shown = f"https://orcid.org/{_checked_orcid(found[1])}", "Person"
    elif "orcid" in rest.lower() or re.search(r"\d{4}-\d{4}", rest):
        raise DataError("an ORCID has four groups of four digits", where=text, remedy="Copy it from orcid.org")
    if found is not None:
        rest = rest[: found.start()] + rest[found.end() :]
    name = " ".join(rest.split()).strip(" ,;<>")
    if not name:
        raise DataError("the name is missing", where=text, remedy="Write the name, and the ORCID or ROR behind it")
    if said and shown and said != shown:
        raise DataError("people have an ORCID, bodies a ROR", where=text, remedy="Correct one of the two")
    return Party(name, said or shown or otherwise or _likely(name), address)


def _likely(name: str) -> Literal["Person", "Organization"]:
    return "Organization" if _BODY.search(name) or _BODY_IN_SHORT.search(name) else "Person"


def _checked_orcid(text: str) -> str:
    """Return the ORCID in groups of four. Raises DataError unless its check digit (ISO 7064, mod 11-2) is right."""
    digits = text.replace("-", "").upper()
    total = 0
    for digit in digits[:-1]:
        total = 2 * (total + int(digit))
    right = "0123456789X"[(12 - total % 11) % 11]
    if digits[-1] != right:
        raise DataError(
            "the ORCID is mistyped: its check digit is wrong", where=text, remedy="Copy it from orcid.org"
        )
    return "-".join(digits[at : at + 4] for at in range(0, 16, 4))


def _checked_ror(text: str) -> str:
    """Return the ROR in lower case. Raises DataError unless form and check digits (ISO 7064, mod 97-10) are right."""
    ror = text.lower()
    value = 0
    for digit in ror[:7] if _ROR_FORM.fullmatch(ror) else "":
        value = 32 * value + _ROR_DIGITS.index(digit)
    if _ROR_FORM.fullmatch(ror) is None or int(ror[7:]) != 98 - (100 * value) % 97:
        raise DataError("the ROR is mistyped", where=text, remedy="Copy it from ror.org, such as 05a28rw58")
    return ror


def doi_address(text: str) -> str:
    """Return the address of a DOI, which may be given with or without `doi:` or `https://doi.org/`; "" for "".

    Raises:
        DataError: it has another format.
    """
    if not text:
        return ""
    found = _DOI.fullmatch(text.strip())
    if found is None:
        raise DataError("this is not a DOI", where=text, remedy="Give it as 10.5281/zenodo.1234567")
    return f"https://doi.org/{found[1]}"


def licence_address(text: str) -> str:
    """Return the address of a licence, from its SPDX identifier or its own address; "" for "".

    Raises:
        DataError: it is neither; the remedy names the identifier that is probably meant.
    """
    if not text or re.fullmatch(r"https?://[^\s/]+\.\S+", text):
        return text
    known = {name.lower(): name for name in _LICENCES}
    spelt = known.get(text.lower()) or (text.upper() if _CREATIVE_COMMONS.fullmatch(text.upper()) else "")
    if spelt:
        return f"{_SPDX}{spelt}"
    plain = re.sub(r"[\s_]+", "-", text.strip().lower().replace("creative commons", "cc")).replace(
        "attribution", "by"
    )
    usual = [
        "CC-BY-4.0",
        "CC-BY-NC-4.0",
        "CC-BY-SA-4.0",
        "CC-BY-NC-SA-4.0",
        "CC-BY-ND-4.0",
        "CC-BY-NC-ND-4.0",
        *_LICENCES,
    ]
    near = difflib.get_close_matches(plain, [name.lower() for name in usual], n=1, cutoff=0.6)
    meant = next((name for name in usual if near and name.lower() == near[0]), "CC-BY-4.0")
    raise DataError(
        "this is neither an SPDX identifier nor an address",
        where=text,
        remedy=f"Did you mean {meant}? For another licence, give the address of its text",
    )


def licence_name(address: str) -> str:
    """Return the SPDX identifier in an address that has one; else the address."""
    return address.removeprefix(_SPDX).removesuffix(".html") if address.startswith(_SPDX) else address


FIRST_VERSION = "1.0.0"
VERSION = r"^\d{1,6}\.\d{1,6}\.\d{1,6}$"  # a data set's version: MAJOR.MINOR.PATCH
LONGEST_NAME = 200  # the longest name of a creator, characters
_Name = Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)]
_Line = Annotated[str, Field(max_length=1000)]


class DataSetStatement(Record):
    """An exported data set's statement about itself; what is left out is reported as not given."""

    title: _Line = ""  # the data set's title; without it, the protocol's title and the specimen
    licence: _Line = ""  # SPDX identifier such as CC-BY-4.0, or the licence's address
    ethics: _Line = ""  # approval or waiver, with its number and the body that gave it
    # People, each with an ORCID if possible, or bodies, with a ROR: "Rivera, Ana 0000-0002-1825-0097".
    creators: tuple[_Name, ...] = ()
    cite: _Line = ""  # the way to cite the data set
    doi: _Line = ""  # this data set's DOI, such as 10.5281/zenodo.1234567
    publisher: _Line = ""  # the body that publishes it, with its ROR if possible
    funders: tuple[_Name, ...] = ()  # bodies that paid for it, each with its ROR if possible

    def or_else(self, other: DataSetStatement) -> DataSetStatement:
        """Return this statement, with what it leaves out taken from another."""
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
        """Return the wrong identifiers, by field and index. Old records are read nonetheless, new ones refused."""
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
