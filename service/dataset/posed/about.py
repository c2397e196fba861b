"""What is known about a data set as a whole, for its data card and its metadata."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from service.core.errors import DataError
from service.core.records.data_set import FIRST_VERSION, DataSetStatement, Party, doi_address, licence_address, party
from service.jobs.registration.evaluate import ErrorBudget, Row

NOT_STATED = "not stated"


@dataclass(frozen=True, slots=True)
class UsedDevice:
    """A device as it stated itself when it was opened; "" for what it did not state or what is left out."""

    name: str  # in rig.yaml
    model: str
    serial: str
    firmware: str


@dataclass(frozen=True, slots=True)
class About:
    """A data set as a whole; everything but `stated` and `version` is from the record.

    Attributes:
        stated: title, licence, ethics, creators and citation, from the protocol or the export's options.
        version: of the data set.
        run: identifier of the run.
        protocol: its id, version and SHA-256.
        protocol_title: in words.
        source: where the procedure comes from.
        specimen: as entered at the start of the run.
        purpose: likewise.
        site: likewise.
        origin: how the photographs came into the run, a sentence.
        published_utc: time of the last event that the data set rests on.
        head_sha256: hash of that event.
        software: version of this program.
        people: who took part; empty if personal data are left out.
        devices: that were opened.
        settings: of the camera and of the spheres, (name, value) in words.
        accuracy: the run's own registration in the evaluation's table; None if there is none.
        budget: of its error.
        covariance: what the covariances of the poses hold, a sentence.
        mesh: what the ground-truth mesh is, a sentence.
        masks: what the masks hold.
        fusion: how CT and scan agree and were fused, (name, value) in words; empty if the mesh is the scan.
        gates: verdicts in words, by step.
        accepted: gates accepted outside their limits, in words.
        deviations: from the protocol, in words.
        later: results that arrived after the evaluation, in words.
        not_in_yet: results that had not arrived.
    """

    stated: DataSetStatement = field(default_factory=DataSetStatement)
    version: str = FIRST_VERSION
    run: str = ""
    protocol: str = ""
    protocol_title: str = ""
    source: str = ""
    specimen: str = ""
    purpose: str = ""
    site: str = ""
    origin: str = ""
    published_utc: str = ""
    head_sha256: str = ""
    software: str = ""
    people: tuple[str, ...] = ()
    devices: tuple[UsedDevice, ...] = ()
    settings: tuple[tuple[str, str], ...] = ()
    accuracy: Row | None = None
    budget: ErrorBudget | None = None
    covariance: str = ""
    mesh: str = ""
    masks: str = ""
    fusion: tuple[tuple[str, str], ...] = ()
    gates: tuple[tuple[str, tuple[str, ...]], ...] = ()
    accepted: tuple[str, ...] = ()
    deviations: tuple[str, ...] = ()
    later: tuple[str, ...] = ()
    not_in_yet: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The title that was stated; else the protocol's, and the specimen."""
        known = [self.protocol_title or "Posed images and a surface mesh", self.specimen]
        return self.stated.title or ": ".join(filter(None, known))

    @property
    def licence(self) -> str:
        """The licence in words."""
        return self.stated.licence or "No licence was stated: ask the site that made the data set"

    @property
    def licence_address(self) -> str:
        """The address of the licence; "" where none was stated, or one in words as old protocols have it."""
        try:
            return licence_address(self.stated.licence)
        except DataError:
            return ""

    @property
    def ethics(self) -> str:
        """The ethics statement in words."""
        return self.stated.ethics or "No ethics statement was given, neither in the protocol nor at the export"

    @property
    def creators(self) -> tuple[Party, ...]:
        """Who made the data set: as stated, else the site."""
        site = (Party(self.site, "Organization"),) if self.site else ()
        return tuple(_party(name) for name in self.stated.creators) or site

    @property
    def publisher(self) -> Party | None:
        """Who publishes it, if that was stated."""
        return _party(self.stated.publisher, "Organization") if self.stated.publisher else None

    @property
    def funders(self) -> tuple[Party, ...]:
        """Who paid for it."""
        return tuple(_party(name, "Organization") for name in self.stated.funders)

    @property
    def doi(self) -> str:
        """The address of the data set's DOI, if it was stated and is one."""
        try:
            return doi_address(self.stated.doi)
        except DataError:
            return ""

    @property
    def citation(self) -> str:
        """How to cite it: as stated, else put together from the record."""
        if self.stated.cite:
            return self.stated.cite
        names = ", ".join(maker.name for maker in self.creators)
        whose = f"{names}: " if names else ""
        where = f", {self.publisher.name}" if self.publisher is not None else ""
        which = f", {self.doi}" if self.doi else f", run {self.run}" if self.run else ""
        return f"{whose}{self.title}. Data set, version {self.version}{where}{which}."


def _party(text: str, otherwise: Literal["Person", "Organization", ""] = "") -> Party:
    """A stated person or body; one that an older record has in a wrong form is named as it stands there."""
    try:
        return party(text, otherwise=otherwise)
    except DataError:
        return Party(text, otherwise or "Person")
