"""What to do with a datagram of FRI, apart from sockets: answer it, count it, and tell the driver."""

from __future__ import annotations

from drivers.kuka.fri.sample import FriSample
from drivers.kuka.fri.wire import FriError, Session, decode, reply

_COUNTERS = 1 << 32
_LONGEST_GAP = 10_000  # messages; a larger step means that the controller has restarted
_SILENCE_S = 2.0  # after this, another address may be the controller, and its counter may have started again


class Listener:
    """One session: the first sender of a monitor message is the controller, until it is silent."""

    def __init__(self) -> None:
        self._sender: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._sequence: int | None = None
        self._replies = 0
        self._unanswered = 0
        self._received = self._lost = self._refused = 0

    def take(self, datagram: bytes, sender: tuple[str, int], now_s: float) -> tuple[bytes | None, FriSample | None]:
        """Take a datagram that arrived at this host time.monotonic(); returns the reply and the record, if any."""
        try:
            message = decode(datagram)
        except FriError:
            self._refused += 1
            return None, None
        if self._sender is None or now_s - self._heard_s > _SILENCE_S:
            self._sender, self._sequence = sender, None
        elif sender != self._sender:
            self._refused += 1
            return None, None
        step = 1 if self._sequence is None else (message.sequence - self._sequence) % _COUNTERS
        if step == 0 or step > _COUNTERS - _LONGEST_GAP:  # the same again, or one that was overtaken
            return None, None
        self._heard_s, self._sequence = now_s, message.sequence
        self._received += 1
        self._lost += step - 1 if step < _LONGEST_GAP else 0
        answer = None
        if message.session in (Session.MONITORING_WAIT, Session.MONITORING_READY):
            self._unanswered += 1
            if self._unanswered >= message.answer_every:
                self._unanswered = 0
                answer = reply(message, self._replies)
                self._replies = (self._replies + 1) % _COUNTERS
        return answer, FriSample(
            monotonic_s=now_s,
            time_s=message.time_s,
            joints_rad=message.joints_rad,
            commanded_rad=message.commanded_rad,
            is_normal=message.is_normal,
            session=message.session,
            quality=message.quality,
            period_ms=message.period_ms,
            received=self._received,
            lost=self._lost,
            refused=self._refused,
        )
