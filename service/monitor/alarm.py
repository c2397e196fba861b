"""Alerts people elsewhere when a run has stopped, waits for them or has ended: by webhook and by e-mail."""

from __future__ import annotations

import http.client
import json
import logging
import os
import queue
import smtplib
import ssl
import threading
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from email.message import EmailMessage

from service.core.errors import ConfigurationError
from service.monitor.snapshot import Standing
from service.rig import AlertsSection, EmailSection, Rig, WebhookSection
from service.store.durable_effects import Clock, SystemClock

_TIMEOUT_S = 10.0
_TRIES_S = (0.0, 2.0, 10.0)  # pause before each attempt
_CLOSE_S = 15.0
_log = logging.getLogger(__name__)
_SUBJECT = {"waits": "waits for you", "stopped": "has stopped", "ended": "has ended"}


@dataclass(frozen=True, slots=True)
class Alert:
    """One alert. It names no person."""

    standing: Standing
    run_id: str
    rig: str
    words: str
    at_utc_s: float

    @property
    def subject(self) -> str:
        """The subject line."""
        return f"Run {self.run_id} {_SUBJECT[self.standing]}"

    @property
    def text(self) -> str:
        """The full message."""
        return f"{self.subject}: {self.words} (rig {self.rig})"


class Alarm:
    """Follows the state of a run and sends alerts in a thread of its own: no capture waits for a mail server."""

    def __init__(self, section: AlertsSection, run_id: str, rig: str, *, clock: Clock | None = None) -> None:
        """Raises ConfigurationError if a secret named in the rig file is missing from the environment."""
        self._section, self._run_id, self._rig, self._clock = section, run_id, rig, clock or SystemClock()
        self._senders = _senders(section)
        self._since: tuple[tuple[str, str], float] = (("", ""), 0.0)
        self._told: tuple[str, str] = ("", "")
        self._queue: queue.SimpleQueue[Alert | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._send_all, name="alarm", daemon=True)
        self._thread.start()

    def follow(self, standing: Standing, words: str) -> None:
        """Report the run's current state; called repeatedly. Waiting is reported after a delay, the rest at once."""
        now = (standing, words)
        if now != self._since[0]:
            self._since = (now, self._clock.monotonic_s())
        if standing == "works":
            self._told = ("", "")  # after work has resumed, the same stop is reported again
        lasted_s = self._clock.monotonic_s() - self._since[1]
        due_s = self._section.waits_after_s if standing == "waits" else 0.0
        if standing not in self._section.on or now == self._told or lasted_s < due_s:
            return
        self._told = now
        self._queue.put(Alert(standing, self._run_id, self._rig, words, self._clock.utc_s()))

    def close(self) -> None:
        """Send pending alerts, for some seconds at most."""
        self._queue.put(None)
        self._thread.join(_CLOSE_S)

    def _send_all(self) -> None:
        while (alert := self._queue.get()) is not None:
            for name, send in self._senders:
                _try(name, send, alert, self._clock)


def alarm_of(rig: Rig, run_id: str, clock: Clock) -> Alarm | None:
    """Return the alarm configured in the rig file; None if it has no `alerts`."""
    section = rig.section.alerts
    return None if section is None else Alarm(section, run_id, rig.section.name, clock=clock)


def _try(name: str, send: Callable[[Alert], None], alert: Alert, clock: Clock) -> None:
    for pause_s in _TRIES_S:
        clock.sleep(pause_s)
        try:
            send(alert)
        except (OSError, http.client.HTTPException, smtplib.SMTPException) as error:
            _log.warning("the %s did not accept the alert: %s", name, error)
        else:
            return


def _senders(section: AlertsSection) -> list[tuple[str, Callable[[Alert], None]]]:
    senders: list[tuple[str, Callable[[Alert], None]]] = []
    if section.webhook is not None:
        senders.append(("webhook", _webhook(section.webhook)))
    if section.email is not None:
        senders.append(("mail server", _email(section.email)))
    return senders


def _webhook(section: WebhookSection) -> Callable[[Alert], None]:
    url = section.url or _secret(section.url_env or "")
    if not url.startswith(("http://", "https://")):
        raise ConfigurationError(
            f"{section.url_env} holds no webhook address",
            where="rig.yaml: alerts",
            remedy="It begins with http:// or https://",
        )

    def send(alert: Alert) -> None:
        body = {
            "text": alert.text,  # the field that chat services show
            "run": alert.run_id, "rig": alert.rig, "standing": alert.standing, "words": alert.words,
            "at_utc_s": round(alert.at_utc_s, 3),
        }  # fmt: skip
        request = urllib.request.Request(
            url, json.dumps(body).encode(), {"Content-Type": "application/json"}, method="POST"
        )
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            answer.read(1 << 16)

    return send


def _email(section: EmailSection) -> Callable[[Alert], None]:
    password = _secret(section.password_env) if section.password_env else ""

    def send(alert: Alert) -> None:
        message = EmailMessage()
        message["Subject"], message["From"] = alert.subject, section.sender
        message["To"] = ", ".join(section.to)
        message.set_content(alert.text + "\n")
        with smtplib.SMTP(section.host, section.port, timeout=_TIMEOUT_S) as server:
            if section.starttls:
                server.starttls(context=ssl.create_default_context())
            if section.user:
                server.login(section.user, password)
            server.send_message(message)

    return send


def _secret(name: str) -> str:
    value = os.environ.get(name, "")
    if not value:
        raise ConfigurationError(
            f"{name}, which the rig file names for alerts, is not set in the environment",
            where="rig.yaml: alerts",
            remedy=f"Set {name} where the server and the runs are started, or remove it from the rig file",
        )
    return value
