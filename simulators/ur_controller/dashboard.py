"""The dashboard server's commands: one line in, one line out, in Polyscope's words."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from simulators.ur_controller.controller import Controller
from simulators.ur_controller.modes import Runtime, SafetyMode
from simulators.ur_controller.program import Interpreter

Words = Mapping[tuple[str, str], str]  # a question in small letters, and our answer: a recorded controller's answer
WELCOME = "Connected: Universal Robots Dashboard Server"
_BUILD = {3: "106331 (Jul 07 2021)", 5: "1101319 (Mar 22 2022)"}
_FIXED = {
    "close popup": "closing popup",
    "close safety popup": "closing safety popup",
    "get operational mode": "NONE",
    "quit": "Disconnected",
    "shutdown": "Shutting down",
}

_NOT_ALLOWED = "Command is not allowed due to safety reasons"
REFUSED = f"{_NOT_ALLOWED}, please switch robot to Remote Control mode and reconnect to port 29999"
_LOCAL_TOO = ("addtolog", "popup", "setuserrole")  # beside all queries


class Dashboard:
    """Answers one client's lines. Every requested program file (.urp) exists and runs until it is stopped.

    In local control whatever commands the arm is refused, and to a client that met local control it stays refused
    until it connects again (Universal_Robots_ROS_Driver#262).
    """

    def __init__(self, controller: Controller, interpreter: Interpreter, words: Words | None = None) -> None:
        self._controller = controller
        self._words: Words = words or {}
        self._interpreter = interpreter
        self._met_local = controller.local

    def answer(self, line: str) -> str:
        """Return the reply to one line, without its line end: in recorded words, where there are some for it."""
        command = " ".join(line.strip().split())
        own = self._own(command, command.lower())
        return self._words.get((command.lower(), own), own)

    def _own(self, command: str, word: str) -> str:
        if word in _FIXED:
            return _FIXED[word]
        queries = self._queries()
        if word in queries:
            return queries[word]()
        self._met_local |= self._controller.local
        if self._met_local and word.partition(" ")[0] not in _LOCAL_TOO:
            return REFUSED
        return self._act(command, word)

    def _queries(self) -> dict[str, Callable[[], str]]:
        c, loaded = self._controller, self._interpreter.loaded
        saved = f"true {loaded}" if loaded else "false <unnamed>"
        return {
            "polyscopeversion": lambda: f"URSoftware {self._version()}",
            "version": self._version,
            "get serial number": lambda: c.serial,
            "get robot model": lambda: c.model.name.removesuffix("e"),
            "robotmode": lambda: f"Robotmode: {c.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {c.safety.name}",
            "safetystatus": lambda: f"Safetystatus: {c.safety.name}",
            "is in remote control": lambda: str(not c.local).lower(),
            "running": lambda: f"Program running: {str(c.runtime is Runtime.PLAYING).lower()}",
            "programstate": lambda: f"{c.runtime.name} {loaded or '<unnamed>'}",
            "get loaded program": lambda: f"Loaded program: {loaded}" if loaded else "No program loaded",
            "isprogramsaved": lambda: saved,
        }

    def _act(self, command: str, word: str) -> str:
        c, interpreter = self._controller, self._interpreter
        actions: dict[str, tuple[Callable[[], None], str]] = {
            "power on": (c.power_on, "Powering on"),
            "power off": (c.power_off, "Powering off"),
            "brake release": (c.brake_release, "Brake releasing"),
            "stop": (interpreter.stop, "Stopped"),
            "restart safety": (lambda: None, "Restarting safety"),
        }
        if word in actions:
            actions[word][0]()
            return actions[word][1]
        if word == "unlock protective stop":
            return self._unlock(command)
        if word == "play":
            return "Starting program" if interpreter.play() else f"Failed to execute: {command}"
        if word == "pause":
            return "Pausing program" if interpreter.pause() else f"Failed to execute: {command}"
        verb, _, rest = command.partition(" ")
        if verb.lower() == "load" and rest:
            return self._load(rest)
        replies = {
            "addtolog": "Added log message",
            "popup": "showing popup",
            "setuserrole": f"Setting user role: {rest}",
        }
        return replies.get(verb.lower(), f"could not understand: '{command}'")

    def _load(self, name: str) -> str:
        if not name.endswith(".urp"):
            return f"File not found: {name}"
        self._interpreter.stop()
        self._interpreter.loaded = name
        return f"Loading program: {name}"

    def _unlock(self, command: str) -> str:
        if self._controller.safety is not SafetyMode.PROTECTIVE_STOP:
            return f"Failed to execute: {command}"
        if self._controller.unlock_protective_stop():
            return "Protective stop releasing"
        return (
            "Cannot unlock protective stop until 5s after occurrence. "
            "Always inspect cause of protective stop before unlocking"
        )

    def _version(self) -> str:
        major, minor = self._controller.version
        return f"{major}.{minor}.0.{_BUILD[3 if major < 5 else 5]}"
