"""The sources of camera poses, and the registrations that a step asks for and waits for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from pydantic import BaseModel, ConfigDict

from service.computations.features import SfmEffort
from service.computations.records import PosedPhotograph
from service.computations.register import ARM
from service.core.protocol.models import Protocol, Step

# "robot" is the paper's baseline: the arm's poses as reported. "robot_corrected" removes the arm's errors as the
# hand-eye calibration estimated them, and each pose's error as the spheres show it. "spheres" locates each image of a
# hand-held camera, or of one whose mount on its arm is unknown, by the spheres that it shows. "triangulated" is a
# bundle adjustment of the images' features that starts from the corrected robot poses; COLMAP and GLOMAP start
# without any poses.
Source = Literal["robot", "robot_corrected", "spheres", "triangulated", "colmap", "glomap", "hybrid"]
DEFAULT_SOURCES: tuple[Source, ...] = ("robot", "robot_corrected", "triangulated", "colmap", "glomap", "hybrid")
PLANNED = "sources_planned"  # the note with which a registration records what it waits for and what comes later
QUICK = (*ARM, "spheres")  # computed in seconds, from the outlines alone

_BY_PREFERENCE = ("robot_corrected", "robot", "spheres", "triangulated", "colmap", "glomap", "hybrid")


class WantedRegistrations(BaseModel):
    """The registrations that the parameters of a registration step ask for, and the images that they use.

    Attributes:
        images_of: the capture steps' ids.
        control_images_of: capture steps that see the control spheres.
        calibration: the step with the intrinsics.
        poses: the sources of the poses.
        hand_eye: steps with the mount of the camera on its arm.
        reduced: the sizes of reduced images, such as 1920x1080.
        reduced_poses: the sources of the poses for the reduced images.
        structure_from_motion: the limits on image size, features and pairs.
    """

    model_config = ConfigDict(frozen=True)

    images_of: tuple[str, ...]
    control_images_of: tuple[str, ...]
    calibration: str
    poses: tuple[str, ...]
    hand_eye: str | tuple[str, ...] | None = None
    reduced: tuple[str, ...]
    reduced_poses: tuple[str, ...]
    structure_from_motion: SfmEffort

    @classmethod
    def of(cls, params: BaseModel) -> WantedRegistrations:
        """Return those of a registration step with these params."""
        return cls.model_validate(params.model_dump(mode="json"))

    @property
    def captures(self) -> tuple[str, ...]:
        """All capture steps whose images are used."""
        return (*self.images_of, *self.control_images_of)

    @property
    def registrations(self) -> dict[str, tuple[str, str]]:
        """Source and size ("" for the full one) of every registration, by its name."""
        full = {source: (source, "") for source in self.poses}
        return full | {f"{p}_{size}": (p, size) for size in self.reduced for p in self.reduced_poses}


def decisive(protocol: Protocol, step: Step) -> tuple[str, ...]:
    """Return the registrations that a step waits for: those that gates name, and those that take seconds."""
    names = WantedRegistrations.of(step.params).registrations
    measures = [gate.measure for s in (step, *evaluations_of(protocol, step)) for gate in s.gates]
    waited = {name for measure in measures for name in _named(measure, names)} | {n for n in names if n in QUICK}
    if not waited:
        waited = {next((name for name in _BY_PREFERENCE if name in names), next(iter(names)))}
    return tuple(name for name in names if name in waited)


def most_preferred(registrations: Iterable[str]) -> str:
    """Return the one of several registrations to build on; with corrected poses of the arm if there is one."""
    names = tuple(registrations)
    return next((name for name in _BY_PREFERENCE if name in names), names[0])


class _EvaluationParams(BaseModel):
    """The parameter of an evaluation step that names what it evaluates."""

    registration: str


def evaluated_step(evaluation: Step) -> str:
    """Return the registration step that an evaluation step evaluates."""
    return _EvaluationParams.model_validate(evaluation.params.model_dump()).registration


def evaluations_of(protocol: Protocol, registration: Step) -> tuple[Step, ...]:
    """Return the evaluation steps of a registration step."""
    every = (step for step in protocol.steps if step.gives == "accuracy")
    return tuple(step for step in every if evaluated_step(step) == registration.id)


def _named(measure: str, names: Iterable[str]) -> list[str]:
    """Return the longest name that a measure begins with: `robot_corrected_rms_px` does not belong to `robot`."""
    found = sorted((name for name in names if measure.startswith(f"{name}_")), key=len)
    return found[-1:]


def posed(images: Iterable[PosedPhotograph]) -> bool:
    """Return whether the pose of any of the images is known, from a robot or from the spheres."""
    return any(image.T_base_flange is not None or image.T_scene_camera is not None for image in images)


def of_arms(images: Iterable[PosedPhotograph]) -> bool:
    """Return whether an arm carried the camera in any of the images, and no sphere says where that was."""
    return any(image.T_base_flange is not None and image.T_scene_camera is None for image in images)


def needing_mount(poses: Iterable[str]) -> tuple[str, ...]:
    """Return the sources that need the camera's mount on its arm; "triangulated" may start from the spheres."""
    names = tuple(poses)
    needing = ARM if "spheres" in names else (*ARM, "triangulated")
    return tuple(name for name in names if name in needing)
