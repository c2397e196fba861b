"""The simulated rig: every simulator as a child process around one scene, and the rig.yaml for the service."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from simulators.faults import FaultPlan
from simulators.geometry import Array, apply, inverse, look_at
from simulators.hand.technician import MISHAP_EVERY, Hand
from simulators.rig.cameras import CAMERAS, STILL, again, as_recorded, place, section
from simulators.rig.deliveries import (
    add_delivery_arguments,
    check_delivery_arguments,
    delivery_words,
    scan_folders,
    scanner_sections,
)
from simulators.rig.export_processes import ExportProcesses
from simulators.rig.patience import patient
from simulators.rig.replay import NOTHING, Replay, replay_of
from simulators.rig.truth import truth_of
from simulators.rig.world_server import World, WorldServer
from simulators.scene.arm import ARM_ERRORS, ARM_ERRORS_USUAL
from simulators.scene.further_cameras import PLACES, FurtherCamera, further_cameras
from simulators.scene.world import ARMS, SCENE_CENTRE_M, STATIONS, Scene, nominal_hand_eye
from simulators.serve import SimulatorError, Termination, add_patience, announce
from simulators.sony_camera.recorded import names as bodies

_LOAD_KG = 1.6  # camera, lens and mount
_TAPE_SIGMA_M = 0.003  # accuracy with which a technician measures the scene's centre with a tape


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--scene", type=int, required=True, metavar="SEED", help="seed of the scene")
    parser.add_argument("--dir", type=Path, required=True, help="folder for rig.yaml, CT, scans, truth and logs")
    parser.add_argument("--image-width", type=int, default=1536, metavar="W", help="image width of the photographs")
    parser.add_argument("--speed-up", type=float, default=1.0, metavar="N", help="the arm takes 1/N of its time")
    add_delivery_arguments(parser)
    parser.add_argument("--arm", choices=ARMS, default=ARMS[0], help="model of the arm; each has its own stations")
    parser.add_argument(
        "--arm-errors",
        choices=ARM_ERRORS,
        default=ARM_ERRORS_USUAL,
        help="what the controller of an UR10e does not know of its arm: how it was built, its gears' errors, or both",
    )
    parser.add_argument("--camera", choices=tuple(CAMERAS), default="Sony ILCE-7RM5", help="model of the camera")
    parser.add_argument(
        "--recorded", choices=bodies(), metavar="BODY", help="what this Sony was recorded to state, instead"
    )
    parser.add_argument("--version", default="5.12", help="of Polyscope")
    parser.add_argument(
        "--arms", type=int, choices=(1, 2), default=1, help="one arm that is moved, or one per station"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address of the first controller")
    parser.add_argument(
        "--hand",
        choices=tuple(MISHAP_EVERY),
        help="no arm: a technician holds the camera, and makes this many mistakes",
    )
    parser.add_argument(
        "--second-camera",
        nargs="+",
        choices=PLACES,
        default=(),
        metavar="PLACE",
        help="fixed on a stand in the room, or stereo beside the first one on the arm; with both, there are three",
    )
    parser.add_argument(
        "--second-camera-model",
        nargs="+",
        choices=STILL,
        default=(),
        metavar="MODEL",
        help="model of each of these; default: that of the first camera",
    )
    parser.add_argument(
        "--without-cable", action="store_true", help="with --hand: the camera sends its photographs into a folder"
    )
    parser.add_argument(
        "--revive-after-s",
        type=float,
        metavar="S",
        help="restart a device that died after S seconds; default: end the rig",
    )
    parser.add_argument(
        "--ahead", action="store_true", help="compute what the CT and the scanner deliver before it is asked for"
    )
    parser.add_argument(
        "--replay",
        type=Path,
        metavar="FILE",
        help="arms and camera serve what `orthocapture doctor --record FILE` wrote; the ready line names the rest",
    )
    add_patience(parser)


def serve(args: argparse.Namespace) -> None:
    """Start everything, print the ready line and serve until SIGTERM."""
    if args.without_cable and not args.hand:
        raise SimulatorError("--without-cable is for a camera that a person holds: add --hand")
    if args.second_camera and args.hand:
        raise SimulatorError("--second-camera needs an arm: leave --hand out")
    if len(args.second_camera_model) > len(args.second_camera):
        raise SimulatorError("--second-camera-model names more cameras than --second-camera places")
    if args.camera not in STILL and (args.hand or len(args.second_camera_model) < len(args.second_camera)):
        raise SimulatorError(f"--camera {args.camera} can neither be held nor be a second camera: choose a still one")
    if args.recorded and CAMERAS[args.camera] != "camera":
        raise SimulatorError(f"--recorded is for a Sony: leave --camera {args.camera} out")
    check_delivery_arguments(args)
    replay = NOTHING if args.replay is None else replay_of(args.replay.resolve())
    if replay.arms:
        args.arm, args.arms = replay.arm, replay.arms
    if replay.camera:
        args.camera = STILL[0]
    termination = Termination()
    rig = _Rig(args, termination, replay)
    try:
        rig.start()
        termination.wait()
    finally:
        rig.stop()


class _Rig:
    def __init__(self, args: argparse.Namespace, termination: Termination, replay: Replay) -> None:
        self.args = args
        self.replay = replay
        self.termination = termination
        self.folder: Path = args.dir.resolve()
        self.faults: FaultPlan = args.faults
        scene = Scene.generate(args.scene, arm=args.arm, arms=args.arms, arm_errors=args.arm_errors)
        self.arms = () if args.hand else ("robot",) if args.arms == 1 else ("robot_1", "robot_2")
        self.children: dict[str, subprocess.Popen[str]] = {}
        self._words: dict[str, tuple[str, ...]] = {}  # command line with which each was started
        self._ready: dict[str, dict[str, Any]] = {}  # ready line of each
        self.further = further_cameras(scene, args.second_camera)
        self.world = World(
            scene,
            args.image_width,
            self.arms,
            _start_joints(scene),
            further=self.further,
            camera_held=bool(args.hand),
        )
        self.hand = args.hand and Hand(
            args.hand, args.scene, self.world.hold, self.world.press_shutter, SCENE_CENTRE_M.copy()
        )
        self.server = WorldServer(self.world, self._act)
        self._exports = ExportProcesses(
            self.folder / "logs", self._export_command, ahead=args.ahead, running=lambda: not termination.is_set()
        )
        self._writing = threading.Lock()
        self._truth: dict[str, Any] = {}

    @property
    def scene(self) -> Scene:
        """The scene in its current state."""
        return self.world.scene

    # --- life ---

    def start(self) -> None:
        # Start this first: stop() waits for the server's loop, and would wait for ever if the loop had never begun.
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        try:
            for name in ("ct", *scan_folders(self.args), "photographs", "logs"):
                (self.folder / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SimulatorError(f"the folder {self.folder} cannot be used: {error.strerror}") from error
        world = self.server.address
        joints = ",".join(f"{q:.6f}" for q in self.world.start_joints_rad)
        hosts = self._hosts()
        for arm, host in zip(self.arms, hosts, strict=True):
            self._child(
                arm, self.scene.arm.simulator, "--host", host, "--speed-up", str(self.args.speed_up),
                f"--initial-joints={joints}", "--world", world, "--arm", arm,
                "--patience", str(self.args.patience), *self._model(),
            )  # fmt: skip
        camera = self._child(
            "camera", self.replay.camera or CAMERAS[self.args.camera],
            *place(self.args.camera, self.args.host, self.folder),
            "--world", world, "--image-width", str(self.args.image_width),
            "--exposures-log", str(self._exposures_log("camera")),
            *(("--send-to", str(self.folder / "photographs")) if self.args.without_cable else ()),
            *(as_recorded(self.args.recorded) if self.args.recorded else ()),
        )  # fmt: skip
        models = [*self.args.second_camera_model, *[self.args.camera] * len(self.further)]
        for (name, further), model in zip(self.further.items(), models, strict=False):
            self._start_further(name, further, model)
        self._child("lightbox", "lightbox", "--link", str(self.folder / "lightbox"), "--world", world)
        self._write_truth()
        rig = self.folder / "rig.yaml"
        rig.write_text(yaml.safe_dump(self._rig_file(camera, hosts), sort_keys=False))
        announce(
            rig=str(rig),
            world=world,
            truth=str(self.folder / "truth.json"),
            ct_folder=str(self.folder / "ct"),
            scan_folder=str(self.folder / "scans"),
            not_served=[*self.replay.not_served, *self._left_out()],
        )
        if sys.stdout.isatty():
            sys.stderr.write(self._next_commands())
        threading.Thread(target=self._watch, daemon=True).start()
        self._exports.prepare_after("start")

    def _next_commands(self) -> str:
        """Return what a person at a terminal types next; a program that reads the ready line is told nothing."""
        rig = shlex.quote(str(self.args.dir / "rig.yaml"))
        protocol = "handheld_spine" if self.args.hand else "demo" if self.args.arm == "UR10e" else "exvivo_spine"
        return (
            "The rig is ready, and stays so until Ctrl-C. Next, in another terminal, in the browser:\n"
            f"  orthocapture serve --rig {rig} --data runs\n"
            "or in the terminal:\n"
            f'  orthocapture run {protocol} --rig {rig} --data runs --operator "A. Name" --specimen "Spine 7"\n'
        )

    def _left_out(self) -> Iterator[str]:
        """What the simulators that serve a recording answer by themselves."""
        for name, ready in self._ready.items():
            yield from (f"{name}, {what}" for what in ready.get("not_served", ()))

    def _start_further(self, name: str, further: FurtherCamera, model: str) -> None:
        """Start a further camera's simulator, and write its calibration, which is exact."""
        self._child(
            name, CAMERAS[model], "--port", "0", "--world", self.server.address, "--camera", name,
            "--image-width", str(self.args.image_width), "--clock-ahead-s", str(further.clock_ahead_s),
            "--exposures-log", str(self._exposures_log(name)),
        )  # fmt: skip
        calibration = further.lens.scaled(self.args.image_width).to_json()
        (self.folder / f"{name}.json").write_text(json.dumps(calibration, indent=1))

    def _exposures_log(self, camera: str) -> Path:
        return self.folder / ("truth_exposures.jsonl" if camera == "camera" else f"truth_exposures_{camera}.jsonl")

    def stop(self) -> None:
        for process in self.children.values():
            process.terminate()
        processes = [*self.children.values(), *self._exports.stop()]
        for process in processes:
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for process in self.children.values():
            if process.stdout is not None:
                process.stdout.close()
        self.server.shutdown()
        self.server.server_close()

    def _watch(self) -> None:
        """End the rig when a device has died, since it is of no use then, and report it on stderr."""
        while not self.termination.wait(0.2):
            for name, process in self.children.items():
                if process.poll() is not None and not self.termination.is_set():
                    sys.stderr.write(f"{name} ended with status {process.returncode}: see {self.folder}/logs\n")
                    if self.args.revive_after_s is None or self.termination.wait(self.args.revive_after_s):
                        self.termination.set()
                        return
                    self._revive(name)
                    break

    def _revive(self, name: str) -> None:
        """Restart a device at the same address: an arm with its last joints, a camera with its file counter."""
        words = list(self._words[name])
        if name in self.arms:
            joints = ",".join(f"{q:.6f}" for q in self.world.joints_rad(name))
            words = [f"--initial-joints={joints}" if w.startswith("--initial-joints") else w for w in words]
        if name in ("camera", *self.further):
            log = self._exposures_log(name)
            taken = len(log.read_text().splitlines()) if log.exists() else 0
            words += again(self._ready[name], taken)  # these override the first ones
        with suppress(SimulatorError):  # it is retried
            self._child(name, *words)

    def _child(self, name: str, *words: str) -> dict[str, Any]:
        """Start a simulator and wait for its ready line."""
        command = [
            sys.executable, "-m", "simulators", *words, *self.replay.words.get(name, ()),
            "--parent", str(os.getpid()),
            "--faults", (self.faults.of(name, "camera") if name in self.further else self.faults).to_json(),
        ]  # fmt: skip
        with (self.folder / "logs" / f"{name}.log").open("w") as log:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True
            )
        self.children[name] = process
        self._words[name] = words
        self._ready[name] = ready = _ready_line(process, name, self.folder)
        return ready

    def _model(self) -> tuple[str, ...]:
        """Options that only this kind of controller has."""
        if self.scene.arm.simulator == "kuka":
            return ("--model", self.scene.arm.name, "--true-load-kg", str(_LOAD_KG))
        return ("--model", self.scene.arm.name, "--version", self.args.version)

    # --- what the service reads ---

    def _hosts(self) -> list[str]:
        first = self.args.host
        stem, _, last = first.rpartition(".")
        return [first, f"{stem}.{int(last) + 1}"][: len(self.arms)]

    def _rig_file(self, camera: dict[str, Any], hosts: list[str]) -> dict[str, Any]:
        driver = {"ur": "ur", "kuka": "kuka_sunrise"}[self.scene.arm.simulator]
        robots = {arm: {"driver": driver, "host": host} for arm, host in zip(self.arms, hosts, strict=True)}
        devices: dict[str, dict[str, Any]] = {
            **robots,
            "camera": self._camera(camera),
            **{name: self._camera(self._ready[name]) for name in self.further},
            **scanner_sections(self.args),
            "ct": {"driver": "dicom_folder", "folder": "ct", "stable_s": 1.0},
            "lightbox": {"driver": "lightbox", "port": "lightbox"},
        }
        rig: dict[str, Any] = {
            "name": f"simulated rig, scene {self.scene.seed}",
            "simulated": True,
            "hands": self.server.address,
            "devices": {name: patient(section, self.args.patience) for name, section in devices.items()},
        }
        if self.further:
            rig["cameras"] = {
                name: {"mounted": "fixed" if one.fixed else "rigid", "calibration": f"{name}.json"}
                for name, one in self.further.items()
            }
        if not robots:
            return rig
        return {
            **rig,
            "stations": {name: self._station(i, name) for i, name in enumerate(STATIONS)},
            "T_flange_camera_nominal": nominal_hand_eye().tolist(),
            "payload": {"mass_kg": _LOAD_KG, "centre_of_gravity_m": [0.0, 0.0, 0.08]},
            "collision": {"arm": self.scene.arm.name},
            "lens": self._lens(),
        }

    def _camera(self, ready: dict[str, Any]) -> dict[str, Any]:
        if self.args.without_cable:
            return {"driver": "photo_folder", "folder": "photographs", "stable_s": 1.0}
        return section(ready, self._exposure_s())

    def _exposure_s(self) -> float:
        """Longest time that one picture may take: this camera renders it, in up to some microseconds a pixel."""
        pixels = self.args.image_width**2 * 2 / 3
        return round(40.0 + 4e-6 * pixels, 0)

    def _lens(self) -> dict[str, Any]:
        """Nominal lens data, as engraved on the lens; the true lens differs by about a percent."""
        lens = self.scene.camera_intrinsics(self.args.image_width)
        return {"focal_length_mm": 50.0, "sensor_width_mm": 35.7, "image_px": [lens.width, lens.height]}

    def _station(self, index: int, name: str) -> dict[str, Any]:
        T_base_world = inverse(self.scene.T_world_base[name])
        error = np.random.default_rng([self.scene.seed, 0x7A9E, index]).normal(0.0, _TAPE_SIGMA_M, 3)
        centre = apply(T_base_world, SCENE_CENTRE_M) + error
        return {
            "robot": self.arms[index % len(self.arms)],
            "scene_centre_m": [round(float(v), 3) for v in centre],
            "approach_azimuth_deg": round(float(np.degrees(np.arctan2(-centre[1], -centre[0]))), 1),
        }

    # --- what only tests and the demo read ---

    def _write_truth(self) -> None:
        if not self._truth:
            self._truth = truth_of(self.scene, self.further, self.args.image_width)
        self._truth |= {"registration_m": self.scene.registration_m.tolist(), "moved": self.scene.moved}
        (self.folder / "truth.json").write_text(json.dumps(self._truth, indent=1))

    # --- hands ---

    def _act(self, request: Mapping[str, Any]) -> dict[str, Any]:
        match request.get("action"):
            case "hand_scan":
                return self._deliver(str(request.get("device") or "scanner"))
            case "read":
                if self.hand:
                    self.hand.read(str(request.get("words", "")))
                return {"ok": True}
            case "ct_scan":
                answer = self._deliver("ct")
            case "move_sphere":
                answer = self.world.act(request)
                with self._writing:
                    self._write_truth()
            case _:
                answer = self.world.act(request)
        self._exports.prepare_after(str(request.get("action")))
        return answer

    def _deliver(self, device: str) -> dict[str, Any]:
        """Let a scanner or the CT deliver one export of the scene in its current state."""
        report = self._exports.deliver(device)
        if report["ok"]:
            with self._writing:
                truth = report.pop("truth")
                if device == "ct":
                    self._truth["ct"].append(truth)
                else:
                    self._truth["scans"].append({**truth, "device": device})
                self._write_truth()
        return report

    def _export_command(self, device: str) -> tuple[str, ...]:
        """The command line of the simulator that exports the scene in its current state.

        Raises LookupError if there is no such device.
        """
        words = delivery_words(self.args, device, self.folder, spray=self.world.spray)
        spheres = "--control-spheres" if self.world.control_spheres else "--no-control-spheres"
        return (
            *words, "--scene", str(self.scene.seed), spheres,
            "--moved", json.dumps(self.scene.moved), "--faults", self.faults.to_json(),
        )  # fmt: skip


def _start_joints(scene: Scene) -> Array:
    """Joints at which the camera is above the scene at station 1, looking down."""
    eye = SCENE_CENTRE_M + np.array([0.0, -0.1, 0.62])
    T_world_camera = look_at(eye, SCENE_CENTRE_M, np.array([0.0, 1.0, 0.0]))
    T_base_flange = inverse(scene.T_world_base[STATIONS[0]]) @ T_world_camera @ inverse(nominal_hand_eye())
    q = scene.arm.joints_for(T_base_flange)
    if q is None:
        raise SimulatorError("the arm does not reach the scene")
    return q


def _ready_line(process: subprocess.Popen[str], name: str, folder: Path) -> dict[str, Any]:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        process.wait(timeout=10)
        log = (folder / "logs" / f"{name}.log").read_text().strip()
        raise SimulatorError(f"{name} did not start: {log.splitlines()[-1] if log else 'no reason given'}")
    return json.loads(line)
