"""The simulated scene: specimen, spheres, table, stations and the true geometry of arm, hand-eye and camera."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simulators.geometry import Array, Ints, from_euler
from simulators.scene.arm import ARM_ERRORS_USUAL, ARM_MODEL, ArmErrorKind, ArmErrors, SimulatedArm, UniversalRobot
from simulators.scene.intrinsics import FULL_HEIGHT, FULL_WIDTH, Intrinsics
from simulators.scene.lbr_arm import LBR_MODELS, Lbr, LbrErrors
from simulators.scene.parts import Part, box, cylinder, join_parts, sphere_mesh
from simulators.scene.specimen import Specimen

RADIUS_M = 0.015
BOARD_HALF_M = (0.235, 0.170)
BOARD_THICKNESS_M = 0.018
POST_RADIUS_M = 0.005
BOARD_SQUARES = (24, 17)  # along the board's x and y
BOARD_SQUARE_M = 0.015
# The calibration board is bent, as printed and glued plates are: by how much its middle sags between the outermost
# inner corners of a row, and of a column. Nothing outside the simulators knows it.
BOARD_BOW_M = (0.9e-4, 0.4e-4)
SCENE_CENTRE_M = np.array([0.0, 0.0, 0.05])
STATIONS = ("station_1", "station_2")
NOMINAL_LUX = 45_000.0
_AS_BUILT = 0xFAC7  # of the random numbers for how an arm was built, apart from those of the rest of the scene
ARMS = (ARM_MODEL.name, *sorted(LBR_MODELS))  # that a rig can hold

Moved = tuple[tuple[int, float, float, float], ...]  # moved registration spheres: index and centre (m, world)


def parse_moved(text: str) -> Moved:
    """Parse the value of `--moved`: JSON [[index, x, y, z], …]."""
    return tuple((int(index), float(x), float(y), float(z)) for index, x, y, z in json.loads(text))


def nominal_hand_eye() -> Array:
    """Nominal T_flange_camera from the mount's drawing: the camera looks along the flange's z, its top towards -y."""
    return from_euler(np.zeros(3), np.array([0.0, -0.055, 0.095]))


def board_sag_m(x_m: Array, y_m: Array) -> Array:
    """How far the calibration board's surface lies behind the plane z = 0 of its frame, at x and y in this frame."""
    half = 0.5 * BOARD_SQUARE_M * (np.array(BOARD_SQUARES) - 2.0)
    across, along = (np.clip(place / h - 1.0, -1.5, 1.5) for place, h in zip((x_m, y_m), half, strict=True))
    return BOARD_BOW_M[0] * (1.0 - across**2) + BOARD_BOW_M[1] * (1.0 - along**2)


@dataclass(frozen=True)
class SecondArm:
    """An arm of the same model at station 2, with errors of its own, and the camera as it is mounted there."""

    arm: SimulatedArm
    T_flange_camera: Array


@dataclass(frozen=True)
class Scene:
    """The ground truth of the simulated laboratory. World: z up, origin at the centre of the wooden board's top."""

    seed: int
    specimen: Specimen
    registration_m: Array  # (10, 3)
    control_m: Array  # (3, 3)
    foot_m: Array  # (10, 3) feet of the registration spheres' posts
    T_flange_camera: Array
    arm: SimulatedArm
    T_world_base: dict[str, Array]
    lens: Intrinsics  # at full resolution
    lamp_m: Array
    light_lux: float
    temperature_c: float
    moved: Moved = ()
    second: SecondArm | None = None  # None: the one arm is moved to station 2

    @property
    def radius_m(self) -> float:
        """Radius of all spheres."""
        return RADIUS_M

    @classmethod
    def generate(
        cls,
        seed: int,
        moved: Moved = (),
        arm: str = ARM_MODEL.name,
        arms: int = 1,
        arm_errors: ArmErrorKind = ARM_ERRORS_USUAL,
    ) -> Scene:
        """Generate this seed's scene, identical on every machine and in every process, with some spheres moved.

        Another model of arm stands at other stations; everything else of the scene is the same. Of two arms, the
        second one stands at station 2. `arm_errors` are those of an UR10e; an LBR has its own.
        """
        scene = cls._as_set_up(seed, arm_errors)
        if arm != ARM_MODEL.name:
            rng = np.random.default_rng([seed, 0x1B2])
            errors = LbrErrors.draw(rng)
            scene = replace(scene, arm=Lbr(errors, LBR_MODELS[arm]), T_world_base=_lbr_bases(rng))
        if arms == 2:
            scene = replace(scene, second=_second_arm(seed, arm, scene.T_flange_camera, arm_errors))
        for index, *centre in moved:
            scene = scene.with_sphere_at(int(index), np.array(centre))
        return scene

    def with_sphere_at(self, index: int, centre_m: Array) -> Scene:
        """Return the scene with a registration sphere, on its post, moved to a centre (3,) in the world."""
        centres, feet = self.registration_m.copy(), self.foot_m.copy()
        feet[index, :2] += centre_m[:2] - centres[index, :2]
        centres[index] = centre_m
        others = tuple(entry for entry in self.moved if entry[0] != index)
        x, y, z = (float(v) for v in centre_m)
        return replace(self, registration_m=centres, foot_m=feet, moved=(*others, (index, x, y, z)))

    @classmethod
    def _as_set_up(cls, seed: int, arm_errors: ArmErrorKind) -> Scene:
        rng = np.random.default_rng([seed, 0x5CE11E])
        specimen = Specimen.generate(rng)
        registration, feet = _registration_spheres(rng)
        control = _control_spheres(rng, specimen)
        offset = rng.uniform(-1.0, 1.0, 6)
        nominal = nominal_hand_eye()
        T_flange_camera = nominal @ from_euler(np.radians(0.7) * offset[:3], 0.0014 * offset[3:])
        return cls(
            seed=seed,
            specimen=specimen,
            registration_m=registration,
            control_m=control,
            foot_m=feet,
            T_flange_camera=T_flange_camera,
            arm=UniversalRobot(ArmErrors.draw(rng).of_kind(arm_errors, np.random.default_rng([seed, _AS_BUILT]))),
            T_world_base=_bases(rng),
            lens=_lens(rng),
            lamp_m=np.array([0.16, -0.24, 1.05]) + rng.uniform(-0.05, 0.05, 3),
            light_lux=NOMINAL_LUX * float(rng.uniform(0.96, 1.04)),
            temperature_c=float(rng.uniform(20.5, 22.5)),
        )

    # What the scene contains
    def sphere_centres_m(self, control: bool) -> Array:
        """Centres of the control (3, 3) or registration (10, 3) spheres, world frame."""
        return self.control_m if control else self.registration_m

    @cached_property
    def fixed_parts(self) -> tuple[Part, ...]:
        """Specimen, wooden board, posts and K-wires: closed solids that touch or slightly overlap."""
        hx, hy = BOARD_HALF_M
        low, high = np.array([-hx, -hy, -BOARD_THICKNESS_M]), np.array([hx, hy, 0.0])
        wood = box(low, high, cell_m=0.0025)
        board = Part("board", "board", wood.vertices_m, wood.faces, wood.uv)
        posts = join_parts("posts", "post", [self._post(i) for i in range(len(self.foot_m))])
        wires = join_parts("wires", "steel", [cylinder(a, b, 0.001, 12, 10, (0.0, 1.0)) for a, b in self._wires()])
        return (self.specimen.part(), board, posts, wires)

    def parts(self, control_spheres: bool) -> tuple[Part, ...]:
        """fixed_parts and the spheres; each sphere is a part of its own, with its vertices on the true sphere."""
        centres = [*self.registration_m, *(self.control_m if control_spheres else ())]
        return (*self.fixed_parts, *(sphere_mesh(centre, RADIUS_M, 5) for centre in centres))

    def solid_mesh(self, control_spheres: bool) -> tuple[Array, Ints]:
        """Vertices (V, 3) in metres and outward faces (F, 3) of all parts: what a scanner or CT sees.

        The parts are closed and may overlap: a point is inside the scene if it is inside any part.
        """
        parts = self.parts(control_spheres)
        offsets = np.cumsum([0, *(len(part.vertices_m) for part in parts[:-1])])
        faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
        return np.concatenate([part.vertices_m for part in parts]), faces

    # Where the camera is
    def camera_intrinsics(self, width: int) -> Intrinsics:
        """The true intrinsics at this image width."""
        return self.lens.scaled(width)

    def arm_at(self, station: str) -> SimulatedArm:
        """The arm that stands at a station."""
        second = None if station == STATIONS[0] else self.second
        return self.arm if second is None else second.arm

    def nominal_flange(self, q: Array) -> Array:
        """T_base_flange as the controller computes it from its encoders (N,), in radians."""
        return self.arm.reported(q)

    def true_flange(self, q: Array, station: str) -> Array:
        """The true T_world_flange: kinematics as built, and where the arm came to rest this time."""
        digest = hashlib.sha256(np.round(q, 5).tobytes() + str(self.seed).encode()).digest()
        noise = np.random.default_rng(int.from_bytes(digest[:8], "big")).standard_normal(3)
        arm = self.arm_at(station)
        T_base_flange = arm.true(q)
        T_base_flange[:3, 3] += arm.repeatability_m / np.sqrt(3.0) * noise
        return self.T_world_base[station] @ T_base_flange

    def true_camera(self, q: Array, station: str) -> Array:
        """The true T_world_camera at joints q (N,)."""
        second = None if station == STATIONS[0] else self.second
        mount = self.T_flange_camera if second is None else second.T_flange_camera
        return self.true_flange(q, station) @ mount

    def board_placement(self, nth: int) -> Array:
        """T_world_board of the calibration board's n-th placement: above the scene, slightly tilted.

        Board frame: origin at the first inner corner, x along the 23 corners, y along the 16, z into the table (the
        camera's viewing direction), squares of 15 mm. The surface lies `board_sag_m` behind z = 0.
        """
        rng = np.random.default_rng([self.seed, 0xB0A2D, nth])
        tilt = np.radians(rng.uniform(1.0, 4.0, 2)) * rng.choice([-1.0, 1.0], 2)
        T_world_centre = from_euler(np.array([np.pi + tilt[0], tilt[1], rng.uniform(-0.15, 0.15)]), np.zeros(3))
        T_world_centre[:3, 3] = [rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02), 0.140]
        half = 0.5 * BOARD_SQUARE_M * (np.array(BOARD_SQUARES) - 2.0)
        return T_world_centre @ from_euler(np.zeros(3), np.array([-half[0], -half[1], 0.0]))

    def _post(self, index: int) -> Part:
        foot, centre = self.foot_m[index], self.registration_m[index]
        top = centre - (centre - foot) / np.linalg.norm(centre - foot) * (RADIUS_M - 0.002)
        return cylinder(foot - [0.0, 0.0, 0.004], top, POST_RADIUS_M, 24, 24, (index / 10, (index + 0.97) / 10))

    def _wires(self) -> list[tuple[Array, Array]]:
        """Start and end points of ten K-wires: four pin the specimen to the board, six hold the incision open."""
        rng = np.random.default_rng([self.seed, 0x3172E5])
        grid = self.specimen.grid_m
        wires: list[tuple[Array, Array]] = []
        for sx in (-1.0, 1.0):
            for sy in (-1.0, 1.0):
                foot = np.array([sx * rng.uniform(0.125, 0.140), sy * rng.uniform(0.040, 0.055), -0.010])
                lean = np.array([*rng.uniform(-0.012, 0.012, 2), 0.0])
                wires.append((foot, foot + lean + [0.0, 0.0, rng.uniform(0.105, 0.125)]))
        for x in (-0.062, 0.004, 0.058):
            for side in (-1.0, 1.0):
                row = grid[np.argmin(np.abs(grid[:, 0, 0] - x - rng.uniform(-0.006, 0.006)))]
                t = self.specimen.anatomy.incision(row[:, 0], row[:, 1])
                same = np.sign(row[:, 1] - self.specimen.anatomy.midline(row[:, 0])) == side
                lip = row[np.argmin(np.where(same, np.abs(t - 0.98), np.inf))]
                out = np.array([rng.uniform(-0.25, 0.25), side * rng.uniform(0.7, 1.0), rng.uniform(0.5, 0.8)])
                out /= np.linalg.norm(out)
                wires.append((lip - 0.012 * out, lip + rng.uniform(0.030, 0.045) * out))
        return wires


def _second_arm(seed: int, model: str, T_flange_camera: Array, arm_errors: ArmErrorKind) -> SecondArm:
    """Another arm of a model; its mount holds the camera up to 0.3 mm and 0.1° elsewhere."""
    rng = np.random.default_rng([seed, 0x2A12])
    is_lbr = model in LBR_MODELS
    if is_lbr:
        arm: SimulatedArm = Lbr(LbrErrors.draw(rng), LBR_MODELS[model])
    else:
        as_built = np.random.default_rng([seed, _AS_BUILT, 2])
        arm = UniversalRobot(ArmErrors.draw(rng).of_kind(arm_errors, as_built))
    offset = rng.uniform(-1.0, 1.0, 6)
    return SecondArm(arm, T_flange_camera @ from_euler(np.radians(0.1) * offset[:3], 0.3e-3 * offset[3:]))


def _registration_spheres(rng: np.random.Generator) -> tuple[Array, Array]:
    """Centres and feet (10, 3) of the spheres around the specimen, at uneven spacing and a few different heights."""
    layout = np.array(
        [
            (-0.128, -0.122, 0.052), (-0.012, -0.132, 0.098), (0.098, -0.121, 0.034), (0.186, -0.088, 0.080),
            (0.198, 0.026, 0.046), (0.142, 0.124, 0.108), (0.036, 0.130, 0.040), (-0.068, 0.122, 0.074),
            (-0.178, 0.092, 0.036), (-0.196, -0.022, 0.090),
        ]
    )  # fmt: skip
    centres = layout + rng.uniform(-1.0, 1.0, layout.shape) * [0.007, 0.004, 0.006]
    feet = centres.copy()
    feet[:, 2] = 0.0
    feet[:, :2] += rng.uniform(-0.0015, 0.0015, (len(layout), 2))
    return centres, feet


def _control_spheres(rng: np.random.Generator, specimen: Specimen) -> Array:
    """Centres (3, 3): two spheres on top of the specimen and one in the incision, each pressed in by 1.5 mm."""
    anatomy = specimen.anatomy
    x = np.array([-0.098, 0.028, 0.104]) + rng.uniform(-0.006, 0.006, 3)
    y = anatomy.midline(x) + np.array([0.056, -0.002, -0.052])
    x[1] = anatomy.phase_m + 0.0155 + 0.017  # between two spinous processes
    points = specimen.grid_m.reshape(-1, 3)
    centres: list[Array] = []
    for xi, yi in zip(x, y, strict=True):
        d2 = np.sum((points[:, :2] - [xi, yi]) ** 2, axis=1)
        near = d2 < RADIUS_M**2
        z = np.max(points[near, 2] + np.sqrt(RADIUS_M**2 - d2[near])) - 0.0015
        centres.append(np.array([xi, yi, z]))
    return np.stack(centres)


def _bases(rng: np.random.Generator) -> dict[str, Array]:
    """T_world_base of the two stations, on opposite sides of the table."""
    bases: dict[str, Array] = {}
    for name, side in zip(STATIONS, (-1.0, 1.0), strict=True):
        yaw = (0.0 if side < 0 else np.pi) + rng.uniform(-0.15, 0.15)
        angles = np.array([*rng.uniform(-0.004, 0.004, 2), yaw])
        position = [rng.uniform(-0.04, 0.04), side * rng.uniform(0.74, 0.80), rng.uniform(-0.10, -0.06)]
        bases[name] = from_euler(angles, np.array(position))
    return bases


def _lbr_bases(rng: np.random.Generator) -> dict[str, Array]:
    """T_world_base of the two stations of an LBR.

    Its reach of 820 mm takes all of the paper's viewpoints only within a centimetre or two of this place: nearer, the
    elbow cannot bend far enough, and farther, the arm is too short.
    """
    bases: dict[str, Array] = {}
    for name, side in zip(STATIONS, (-1.0, 1.0), strict=True):
        yaw = (np.pi / 2 if side < 0 else -np.pi / 2) + rng.uniform(-0.1, 0.1)
        angles = np.array([*rng.uniform(-0.004, 0.004, 2), yaw])
        position = [rng.uniform(-0.03, 0.03), side * rng.uniform(0.695, 0.703), rng.uniform(-0.009, -0.003)]
        bases[name] = from_euler(angles, np.array(position))
    return bases


def _lens(rng: np.random.Generator) -> Intrinsics:
    fx = FULL_WIDTH * 1.4 * float(rng.uniform(0.985, 1.015))
    cx, cy = (
        (size - 1) / 2 + float(rng.uniform(0.002, 0.005)) * float(rng.choice([-1.0, 1.0])) * size
        for size in (FULL_WIDTH, FULL_HEIGHT)
    )
    return Intrinsics(
        width=FULL_WIDTH,
        height=FULL_HEIGHT,
        fx=fx,
        fy=fx * float(rng.uniform(0.9996, 1.0004)),
        cx=cx,
        cy=cy,
        k1=float(rng.uniform(-0.065, -0.04)),
        k2=float(rng.uniform(0.015, 0.04)),
        p1=float(rng.uniform(1e-4, 5e-4)) * float(rng.choice([-1.0, 1.0])),
        p2=float(rng.uniform(1e-4, 5e-4)) * float(rng.choice([-1.0, 1.0])),
    )
