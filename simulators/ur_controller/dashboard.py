"""The dashboard server's commands: one line in, one line out, as Polyscope words them."""

from __future__ import annotations

from collections.abc import Callable

from simulators.ur_controller.controller import Controller, Runtime

WELCOME = "Connected: Universal Robots Dashboard Server"
_BUILD = {3: "106331 (Jul 07 2021)", 5: "1101319 (Mar 22 2022)"}


class Dashboard:
    """Answers one client's lines. `stop_program` ends whatever program runs."""

    def __init__(self, controller: Controller, stop_program: Callable[[], None]) -> None:
        self._controller = controller
        self._stop_program = stop_program
        self._loaded = ""
        self._fixed = {
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
            "restart safety": "Restarting safety",
            "isprogramsaved": "true",
            "is in remote control": "true",
            "get operational mode": "NONE",
            "quit": "Disconnected",
            "shutdown": "Shutting down",
        }

    def answer(self, line: str) -> str:
        """The reply to one line, without its line end."""
        c = self._controller
        command = " ".join(line.strip().split())
        word = command.lower()
        queries: dict[str, Callable[[], str]] = {
            "polyscopeversion": lambda: f"URSoftware {self._version()}",
            "version": self._version,
            "get serial number": lambda: c.serial,
            "get robot model": lambda: c.model.name.removesuffix("e"),
            "robotmode": lambda: f"Robotmode: {c.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {c.safety.name}",
            "safetystatus": lambda: f"Safetystatus: {c.safety.name}",
            "running": lambda: f"Program running: {str(c.runtime is Runtime.PLAYING).lower()}",
            "programstate": lambda: f"{c.runtime.name} {self._loaded or '<unnamed>'}",
            "get loaded program": lambda: f"Loaded program: {self._loaded}" if self._loaded else "No program loaded",
        }
        if word in self._fixed:
            return self._fixed[word]
        if word in queries:
            return queries[word]()
        return self._act(command, word)

    def _act(self, command: str, word: str) -> str:
        c = self._controller
        actions: dict[str, tuple[Callable[[], None], str]] = {
            "power on": (c.power_on, "Powering on"),
            "power off": (c.power_off, "Powering off"),
            "brake release": (c.brake_release, "Brake releasing"),
            "stop": (self._stop_program, "Stopped"),
        }
        if word in actions:
            actions[word][0]()
            return actions[word][1]
        if word == "unlock protective stop":
            if c.unlock_protective_stop():
                return "Protective stop releasing"
            return (
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        if word in ("play", "pause"):
            return f"Failed to execute: {word}"
        verb, _, rest = command.partition(" ")
        if verb.lower() == "load" and rest:
            self._loaded = rest
            return f"Loading program: {rest}"
        replies = {
            "addtolog": "Added log message",
            "popup": "showing popup",
            "setuserrole": f"Setting user role: {rest}",
        }
        return replies.get(verb.lower(), f"could not understand: '{command}'")

    def _version(self) -> str:
        major, minor = self._controller.version
        return f"{major}.{minor}.0.{_BUILD[3 if major < 5 else 5]}"
