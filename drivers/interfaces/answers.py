"""What a device says of itself, word for word: for a recording that a stranger can read and a simulator can serve."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict, Field

PropertyType = Literal["i8", "u8", "i16", "u16", "i32", "u32", "i64", "u64", "int", "str"]


SERIES_DESCRIPTION = "SeriesDescription: "  # begins the line of a DICOM header that a person may have written


class Part(BaseModel):
    """Base class of the parts of a recording."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PtpProperty(Part):
    """One property of a still camera."""

    code: str = Field(description="four digits to base 16")
    type: PropertyType = Field(description="i: signed, u: unsigned, and how many bits; int: it is not told")
    access: Literal["rw", "ro", "0/1"] = Field(
        description="as libgphoto2 concluded; 0/1: the bytes GetSet and IsEnabled, where they are known"
    )
    form: Literal["none", "enum", "range"]
    numbers: tuple[int, ...] = Field(default=(), description="choices; or the least, the greatest and the step")
    value: int | str


class Listing(Part):
    """All properties of a still camera, in its order."""

    maker: str
    model: str
    firmware: str
    protocol: int = Field(description="100: plain PTP; 200 and 300: Sony's protocols 2.00 and 3.00")
    controls: tuple[str, ...] = Field(default=(), description="codes of what is pressed or stepped, and has no value")
    properties: tuple[PtpProperty, ...]


class Exchange(Part):
    """A question and its answer, each a line of text as it went over the wire."""

    question: str
    answer: str


class Sample(Part):
    """One sample of numbers by the maker's names; units are the maker's, or stand in the name."""

    source: str
    fields: dict[str, tuple[float, ...]]


class FileHeader(Part):
    """The header of a file that a device exported; neither its name nor what it holds."""

    format: str
    size_bytes: int
    lines: tuple[str, ...]


class DeviceAnswers(Part):
    """Holds what a device said; each driver fills what its device has."""

    listing: Listing | None = None
    exchanges: tuple[Exchange, ...] = ()
    samples: tuple[Sample, ...] = ()
    headers: tuple[FileHeader, ...] = ()
    silent: tuple[str, ...] = Field(default=(), description="what was asked in vain, and why")


def answers_of_headers(read: Iterable[FileHeader | str]) -> DeviceAnswers:
    """The answers of a folder: what was read of each file is its header, or a sentence that says why it has none."""
    every = tuple(read)
    return DeviceAnswers(
        headers=tuple(header for header in every if isinstance(header, FileHeader)),
        silent=tuple(reason for reason in every if isinstance(reason, str)),
    )


@runtime_checkable
class Answering(Protocol):
    """A driver that can say more for a recording than identity and report. Optional."""

    def answers(self) -> DeviceAnswers:
        """Ask the device all that it tells without moving or taking a picture.

        It is also called after `open` has failed, and then says what can be heard nevertheless. Raises DeviceError if
        that is nothing.
        """
        ...


def answers_of(device: object) -> DeviceAnswers:
    """The answers of a device; none of one whose driver does not record. Raises DeviceError."""
    return device.answers() if isinstance(device, Answering) else DeviceAnswers()
