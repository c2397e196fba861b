"""The rig file: the devices and stations of a site, validated; for an import, the list of its files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from drivers.interfaces import Abandoned
from service.core.checked_yaml import (
    NO_LINES,
    FieldPath,
    Plain,
    YamlProblem,
    YamlTree,
    checked,
    decoded,
    field_name,
    parse_yaml,
    problem_of,
    refuse,
)
from service.core.errors import ConfigurationError, DataError, ProtocolError
from service.core.records.base import Record
from service.core.records.import_list import ImportList
from service.core.text_files import parse_json
from service.core.units import metres

_REMEDY = "Compare it with the example in docs/howto/your_hardware.md"

if TYPE_CHECKING:  # the module imports scipy, which would delay the start of a web process
    from service.core.geometry import Transform

Vector3 = tuple[float, float, float]


class ObstacleSection(Record):
    """Something that stands beside the scene, such as another arm where it is parked: a rod of some thickness."""

    from_m: Vector3  # one end of the rod's axis, in the station's base frame
    to_m: Vector3  # the other end
    radius_m: Annotated[float, Field(gt=0, lt=1)]  # the rod's radius, with its round ends


class StationSection(Record):
    """A place where a robot's base stands, with the scene as a technician measured it, in that base frame."""

    robot: str  # name of the device that stands there
    scene_centre_m: Vector3  # centre of the scene in this station's base frame, to a centimetre
    scene_up: Vector3 = (0.0, 0.0, 1.0)  # no other value: arms mounted on walls or ceilings are not supported
    approach_azimuth_deg: float  # direction from the scene to the base, about the base's z axis
    obstacles: dict[str, ObstacleSection] = Field(default_factory=dict)  # by name: another arm, a lamp, a post


class PayloadSection(Record):
    """The load on the flange."""

    mass_kg: Annotated[float, Field(gt=0, lt=50)]  # camera, lens and mount together
    centre_of_gravity_m: Vector3  # the position in the flange frame


class CollisionSection(Record):
    """Obstacles for the planner; the defaults suit a UR10e with a full-frame camera over a board on a table."""

    arm: str | None = None  # arm model, such as UR10e; None: as the controller gives it
    table_below_scene_m: float = 0.07  # distance of the table's top below the scene's centre
    specimen_size_m: Vector3 = (
        0.34,
        0.46,
        0.17,
    )  # along the approach, across it, up; spheres included
    camera_from_m: Vector3 = (0.0, 0.0, -0.09)  # axis of a capsule around body and lens, in the camera's frame
    camera_to_m: Vector3 = (0.0, 0.0, 0.05)  # the other end of that axis
    camera_radius_m: Annotated[float, Field(gt=0, lt=0.3)] = 0.06  # the radius of that capsule
    margin_m: Annotated[float, Field(ge=0, lt=0.2)] = 0.01  # smallest clearance


class OpticsSection(Record):
    """The lens, for computing the depth of field."""

    focal_length_mm: Annotated[float, Field(gt=0)]  # the focal length as it is taped
    aperture_f: Annotated[float, Field(gt=0)]  # the aperture as it is set
    focus_distance_m: Annotated[float, Field(gt=0)]  # the distance from the camera
    blur_um: Annotated[float, Field(gt=0)] = 45.0  # circle of confusion on the sensor, 12 px of 3.76 µm


class LensSection(Record):
    """Nominal data of lens and sensor, from which the first board images are planned."""

    focal_length_mm: Annotated[float, Field(gt=0)]  # engraved on the lens
    sensor_width_mm: Annotated[float, Field(gt=0)]  # width of the sensor
    image_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]  # width and height of the photographs
    focus_distance_m: Annotated[float, Field(gt=0.05)] | None = None  # from the camera; None: focused far away
    tolerance: Annotated[float, Field(gt=0, lt=0.5)] = 0.025  # the relative tolerance of the focal length

    def focal_px(self, width_px: int) -> float:
        """Return the focal length in pixels for images of this width, with the lens's extension at close focus."""
        f_m = metres(self.focal_length_mm)
        extended = 1.0 if self.focus_distance_m is None else self.focus_distance_m / (self.focus_distance_m - f_m)
        return self.focal_length_mm * extended / self.sensor_width_mm * width_px


class FurtherCameraSection(Record):
    """A further camera, which exposes after the first one at the viewpoints of a data set."""

    mounted: Literal["fixed", "rigid"]  # fixed: on a stand in the room; rigid: beside the first camera on its mount
    calibration: str  # camera.json from `calibrate intrinsics` for this camera, relative to the rig file
    every: Literal["viewpoint", "station"] = "viewpoint"  # exposes at each viewpoint, or once at each station
    aperture_f: Annotated[float, Field(gt=0)] | None = None  # None: that of the protocol, as the next three
    exposure_s: Annotated[float, Field(gt=0)] | None = None  # exposure time
    iso: Annotated[int, Field(gt=0)] | None = None  # sensitivity
    image_quality: Literal["JPEG", "RAW+JPEG"] | None = None  # files of an exposure

    @model_validator(mode="after")
    def _seen_once(self) -> Self:
        if self.mounted == "rigid" and self.every == "station":
            raise ValueError("a rigid camera exposes at every viewpoint: leave `every` out")
        return self


class TimestampSection(Record):
    """A time-stamp authority (RFC 3161) that is asked at the end of every run; the run ends even if it fails."""

    url: Annotated[str, Field(pattern=r"^https?://")]  # the address where the authority answers
    certificates: str  # PEM file, relative to the rig file: the authority's root and intermediate certificates
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 10.0  # the time limit for its answer


class WebhookSection(Record):
    """An address that gets each alert as JSON. The rig file is evidence: keep a secret address in a variable."""

    url: Annotated[str, Field(pattern=r"^https?://")] | None = None  # the address itself
    url_env: str | None = None  # environment variable that holds the address

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.url is None) == (self.url_env is None):
            raise ValueError("give either url or url_env")
        return self


class EmailSection(Record):
    """A mail server, and the recipients of alerts."""

    to: Annotated[tuple[str, ...], Field(min_length=1)]  # addresses
    sender: str  # address that the mail comes from
    host: str  # the mail server
    port: Annotated[int, Field(gt=0, lt=65536)] = 587  # the mail server's port
    starttls: bool = True  # true if the connection is encrypted
    user: str = ""  # name at the mail server; empty: no sign-in
    password_env: str = ""  # environment variable that holds the password


class AlertsSection(Record):
    """Alerts to people away from the screen when a run has stopped, waits for a person, or has ended."""

    webhook: WebhookSection | None = None  # a web address to notify
    email: EmailSection | None = None  # people to write to
    on: tuple[Literal["stopped", "waits", "ended"], ...] = ("stopped", "waits", "ended")  # the reported events
    waits_after_s: Annotated[float, Field(ge=0, le=86400)] = 30.0  # a run's wait for a person before an alert


class SigningSection(Record):
    """The replacements for the password when a step is signed or figures are accepted; the password always works."""

    pin: bool = False  # a PIN may
    badge: bool = False  # read by a reader that types the code and Enter


@dataclass(frozen=True, slots=True)
class RigDevice:
    """The driver's statements about a device in the rig file."""

    kind: str  # robot, camera, scanner, ct or lightbox
    abandoned: Abandoned | None  # the end of its motion if the program that drives it dies


class RigSection(Record):
    """The rig file."""

    name: str  # the name of the site or the room, as people know it
    simulated: bool = False  # devices are simulators: everything recorded is marked so
    hands: str | None = None  # HOST:PORT of a simulated technician (simulated rigs only)
    devices: dict[str, dict[str, Any]]  # by a name of your choice: robot, camera, scanner and so on; see Devices
    cameras: dict[str, FurtherCameraSection] = Field(default_factory=dict)  # further cameras, by their device's name
    stations: dict[str, StationSection] = Field(default_factory=dict)  # the stations, by the name that protocols use
    # The camera mount's drawing: a rigid 4×4 matrix, metres; the calibration replaces it.
    T_flange_camera_nominal: tuple[tuple[float, float, float, float], ...] | None = None
    payload: PayloadSection | None = None  # the payload that the arm is configured for
    collision: CollisionSection = CollisionSection()  # the things that the plan of motions avoids
    optics: OpticsSection | None = None  # None: depth of field is not judged
    lens: LensSection | None = None  # required if the software plans the board poses
    timestamp: TimestampSection | None = None  # None: no time stamps
    signature_copy: str | None = None  # file elsewhere, such as on a share, that gets a copy of the log of signatures
    alerts: AlertsSection | None = None  # None: no alerts
    signing: SigningSection = SigningSection()  # the replacements for a password
    imported: ImportList | None = None  # the files of an import; None for a run that captures


@dataclass(frozen=True, slots=True)
class Rig:
    """A rig file as read."""

    section: RigSection
    path: Path
    source: bytes
    tree: YamlTree = NO_LINES  # line numbers for problems that drivers find later

    @property
    def folder(self) -> Path:
        """The folder of the rig file, to which relative paths in it refer."""
        return self.path.parent

    def nominal_T_flange_camera(self) -> Transform:
        """Return T_flange_camera (4, 4) in metres from the mount's drawing.

        Raises ConfigurationError if the rig file has none, or if it is not rigid.
        """
        rows = self.section.T_flange_camera_nominal
        where = str(self.path)
        if rows is None:
            raise ConfigurationError(
                "the rig file has no T_flange_camera_nominal",
                where=where,
                remedy="Give the camera mount's pose on the flange from its drawing (4×4, metres)",
            )
        T = np.array(rows, dtype=np.float64)
        if T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4):
            raise ConfigurationError(
                "T_flange_camera_nominal is not a rigid 4×4 transform",
                where=where,
                remedy="Give four rows of four numbers: a rotation, and the translation in metres",
            )
        return T


def load_rig(path: Path) -> Rig:
    """Read rig.yaml. Raises ConfigurationError that lists every problem with line and field."""
    return parse_rig(read_rig(path), path)


def read_rig(path: Path) -> bytes:
    """Return the bytes of a rig file. Raises ConfigurationError if it cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise ConfigurationError(
            "there is no such rig file",
            where=str(path),
            remedy="Write one as docs/howto/your_hardware.md shows, or try a simulated one: "
            "orthocapture simulate rig --scene 7 --dir rig, then --rig rig/rig.yaml",
        ) from error
    except OSError as error:
        raise ConfigurationError(
            f"cannot read the rig file: {error.strerror}",
            where=str(path),
            remedy="Check the path and its permissions",
        ) from error


def parse_rig(source: bytes, path: Path) -> Rig:
    """Return the rig in a file's bytes. Raises ConfigurationError that lists every problem with line and field."""
    tree = _tree(source, path)
    section, problems = checked(tree.data, RigSection, tree)
    problems += tree.problems
    problems += [YamlProblem(tree.line(at), field_name(at), message) for at, message in _violations(tree.data)]
    if problems or section is None:
        refuse(problems, what="rig file", name=str(path), remedy=_REMEDY, error=ConfigurationError)
    return Rig(section, path.resolve(), source, tree)


def parse_recorded_rig(source: bytes, path: Path) -> Rig:
    """Return the rig of a recorded run, read with the type conversions that older versions allowed.

    Raises ConfigurationError if the bytes are not a rig file.
    """
    tree = _tree(source, path)
    try:
        return Rig(RigSection.model_validate(tree.data), path.resolve(), source, tree)
    except ValidationError as error:
        problems = [problem_of(details, tree, RigSection) for details in error.errors()]
        refuse(problems, what="rig file", name=str(path), remedy=_REMEDY, error=ConfigurationError)


def _violations(data: Plain) -> Iterator[tuple[FieldPath, str]]:
    """Yield (field, what is wrong) beyond the types of the fields; the data may be malformed in any way."""
    devices, stations, cameras = (
        data.get(name) if isinstance(data, dict) else None for name in ("devices", "stations", "cameras")
    )
    known: list[str] = list(devices) if isinstance(devices, dict) else []
    for name in cameras if isinstance(cameras, dict) else ():
        if name not in known:
            yield ("cameras", name), f"{name!r} is not among the devices: {', '.join(known) or 'there are none'}"
    for name, station in stations.items() if isinstance(stations, dict) else ():
        if not isinstance(station, dict):
            continue
        robot, up = station.get("robot"), station.get("scene_up", [0, 0, 1])
        if isinstance(robot, str) and robot not in known:
            among = ", ".join(known) or "there are none"
            yield ("stations", name, "robot"), f"{robot!r} is not among the devices: {among}"
        if isinstance(up, list) and up != [0, 0, 1]:
            yield (
                ("stations", name, "scene_up"),
                "only upright arms are supported: scene_up must be the base's z axis, [0, 0, 1]",
            )


def _tree(source: bytes, path: Path) -> YamlTree:
    """Return the file as plain data. Raises ConfigurationError if it is neither YAML nor JSON, or not a mapping."""
    # An import's list is JSON of thousands of lines, which would take seconds to parse as YAML.
    try:
        tree = _read_json(source, path) if source.startswith(b"{") else _read_yaml(source, path)
    except (DataError, ProtocolError) as error:
        raise ConfigurationError(f"the rig file: {error.what}", where=error.where, remedy=error.remedy) from error
    if not isinstance(tree.data, dict):
        raise ConfigurationError("the rig file is not a mapping of fields", where=str(path), remedy=_REMEDY)
    return tree


def _read_yaml(source: bytes, path: Path) -> YamlTree:
    return parse_yaml(decoded(source, name=str(path), error=ConfigurationError), name=str(path))


def _read_json(source: bytes, path: Path) -> YamlTree:
    return replace(NO_LINES, data=parse_json(source, name=str(path)))
