"""Counts how often noise on the light box's line would let the robot move (`python -m bench.motion.pedal_noise`).

Nobody presses the pedal while a question stays open. First the driver and the pedal of a run read a box over a line
on which each bit is wrong with a given probability, poll by poll. Then, for a thousand hours, only the lines are
drawn: a line without an error tells the truth, so all that could confirm anything is a line that is wrong and yet
passes its checksum. Beside them stands the rule of before: any larger number is a press.
"""

from __future__ import annotations

import argparse
import binascii
import json
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.stats import binom

from bench.machine import RESULTS, commit, machine
from drivers.errors import DeviceError
from drivers.lightbox import LightboxConfig, SerialLightbox, with_checksum, without_checksum
from service.core.run.decide import AskOperator
from service.runner.leave import SECOND_PRESS_S, Pedal

POLL_S = 0.1  # service/runner/loop.py
QUESTION = AskOperator("capture", "confirm", "Move?", (), ("confirm",))
_COUNT, _UP_S = 6, 3600.0


@dataclass
class NoisyLine:
    """A serial port to a box whose pedal nobody presses: each bit is wrong with probability `bit_errors`."""

    bit_errors: float
    random: np.random.Generator
    checks: bool = True
    now_s: float = 0.0
    in_waiting: int = 0
    write_timeout: float = 0.0
    asked: int = 0
    wrong: int = 0  # replies with an error
    _reply: bytes = field(default=b"", init=False)

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        self._reply, self.in_waiting = b"", 0

    def close(self) -> None:
        """Do nothing: there is no port."""

    def write(self, request: bytes) -> None:
        """Carry a request to the box, which answers at once."""
        self.asked += 1
        heard = self._disturbed(request).strip().decode("latin-1")
        bare = without_checksum(heard) if self.checks and heard.isascii() else heard
        if bare is None:
            answer = "ERR 4 wrong checksum" if "*" in heard else "ERR 1 unknown request"
        elif bare == "*IDN?":
            answer = f"*IDN a,b,c,{'1.4' if self.checks else '1.3'}"
        elif bare == "PEDAL?":
            times = f" {round(1000 * _UP_S)} {round(1000 * (_UP_S + self.now_s))}" if self.checks else ""
            answer = f"PEDAL {_COUNT}{times}"
        else:
            answer = "ERR 1 unknown request"
        line = (with_checksum(answer) if self.checks else answer).encode() + b"\r\n"
        self._reply = self._disturbed(line)
        self.wrong += self._reply != line
        self.in_waiting = len(self._reply)

    def read(self, size: int) -> bytes:
        """Return what has arrived, `size` bytes at most."""
        read, self._reply = self._reply[:size], self._reply[size:]
        self.in_waiting = len(self._reply)
        return read

    def _disturbed(self, line: bytes) -> bytes:
        count = self.random.binomial(8 * len(line), self.bit_errors)
        changed = bytearray(line)
        for bit in self.random.choice(8 * len(line), count, replace=False):
            changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)


@dataclass
class OldPedal:
    """The rule of before: any larger count is a press, timed by the host when it is read."""

    count: int | None = None
    armed_s: float | None = None

    def confirms(self, count: int, now_s: float) -> bool:
        """Return whether this count would have let the robot move."""
        if self.armed_s is not None and now_s - self.armed_s > SECOND_PRESS_S[1]:
            self.armed_s = None
        pressed = self.count is not None and count > self.count
        self.count = count
        if not pressed:
            return False
        if self.armed_s is None or now_s - self.armed_s < SECOND_PRESS_S[0]:
            self.armed_s = now_s
            return False
        self.armed_s = None
        return True


def poll(bit_errors: float, hours: float, seed: int, *, checks: bool) -> dict[str, Any]:
    """Poll a box for so many hours of an open question, as a run does, or by the rule of before."""
    line = NoisyLine(bit_errors, np.random.default_rng(seed), checks)
    old, confirmed = OldPedal(), 0
    with patch("serial.serial_for_url", lambda *_, **__: line):
        box = SerialLightbox(LightboxConfig(port="line", timeout_s=0.003))
        while True:
            try:
                box.open()
                break
            except DeviceError:
                continue
        pedal = Pedal(box.pedal, lambda: line.now_s, lambda _: None)
        for _ in range(round(hours * 3600 / POLL_S)):
            line.now_s += POLL_S
            if checks:
                confirmed += pedal.confirms(QUESTION, moves_robot=True)
                continue
            line.write(b"PEDAL?\n")
            word, _, number = line.read(64).strip().decode("latin-1").partition(" ")
            if word == "PEDAL" and number.isascii() and number.isdecimal():
                confirmed += old.confirms(int(number), line.now_s)
    return {
        "bit_errors": bit_errors, "hours": hours, "checksum": checks, "replies": line.asked, "wrong": line.wrong,
        "confirmations": confirmed,
    }  # fmt: skip


def draw(bit_errors: float, hours: float, seed: int) -> dict[str, Any]:
    """Draw the replies of so many hours: how many were wrong, and how many of those passed the checksum."""
    random = np.random.default_rng(seed)
    line = with_checksum(f"PEDAL {_COUNT} {round(1000 * _UP_S)} {round(1000 * (_UP_S + 1))}").encode()
    bits = 8 * len(line)
    # CRCs are linear: errors pass if the syndromes of their single bits add up to zero.
    syndromes = np.array([_syndrome(line, bit) for bit in range(bits)], dtype=np.int64)
    replies = round(2 * hours * 3600 / POLL_S)  # two readings must agree
    weights = np.arange(bits + 1)
    counts = random.multinomial(replies, _binomial(bits, bit_errors))
    passed = 0
    for errors, many in zip(weights[1:], counts[1:], strict=True):
        for begin in range(0, int(many), 200_000):
            size = min(200_000, int(many) - begin)
            places = np.argpartition(random.random((size, bits)), errors - 1, axis=1)[:, :errors]
            passed += int(np.sum(np.bitwise_xor.reduce(syndromes[places], axis=1) == 0))
    return {
        "bit_errors": bit_errors, "hours": hours, "replies": replies, "wrong": int(counts[1:].sum()),
        "of_four_bits_or_more": int(counts[4:].sum()), "passed": passed,
    }  # fmt: skip


def _syndrome(line: bytes, bit: int) -> int:
    """What one wrong bit changes of (the checksum of what came) xor (the checksum that came); never zero alone.

    A wrong upper half of a checksum's character is no digit, and the asterisk has to stand: both never pass, which a
    value of their own above the checksum's 16 bits says.
    """
    star = len(line) - 5
    place, mask = bit // 8, 1 << bit % 8
    if place < star:
        changed = line[:place] + bytes([line[place] ^ mask]) + line[place + 1 : star]
        return _crc(changed) ^ _crc(line[:star])
    if place == star or mask > 8:
        return 1 << (16 + 8 * (place - star) + bit % 8)
    return mask << 4 * (len(line) - 1 - place)


def _crc(text: bytes) -> int:
    return binascii.crc_hqx(text, 0)


def _binomial(n: int, p: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    probabilities = binom.pmf(np.arange(n + 1), n, p)
    return probabilities / probabilities.sum()


def main() -> None:
    """Measure, print, and record if asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--polled-hours", type=float, default=20.0)
    parser.add_argument("--drawn-hours", type=float, default=1000.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--record", action="store_true", help="write the results to bench/results")
    options = parser.parse_args()
    polled = [
        poll(bit_errors, options.polled_hours, options.seed, checks=checks)
        for checks in (False, True)
        for bit_errors in (1e-4, 1e-3)
    ]
    drawn = [draw(bit_errors, options.drawn_hours, options.seed) for bit_errors in (1e-4, 1e-3)]
    rows = [
        f"| {row['bit_errors']:g} | {'now' if row['checksum'] else 'before'} | {row['hours']:g} | {row['wrong']} of "
        f"{row['replies']} | {row['confirmations']} |"
        for row in polled
    ]
    lines = [
        f"| {row['bit_errors']:g} | {row['hours']:g} | {row['wrong']} of {row['replies']} | "
        f"{row['of_four_bits_or_more']} | {row['passed']} |"
        for row in drawn
    ]
    today = datetime.now(UTC).date().isoformat()
    text = "\n".join([
        f"# What noise on the pedal's line lets move, {today}", "",
        f"`python -m bench.motion.pedal_noise`, seed {options.seed}, revision {commit()}. Nobody presses the pedal.",
        "", "| bit errors | rule | hours | wrong replies | confirmations of a motion |", "|---:|---|---:|---:|---:|",
        *rows, "",
        "Two wrong replies that pass the checksum, are equal, and follow each other would be one press; two presses "
        "would move the robot.", "",
        "| bit errors | hours | wrong replies | of four bits or more | passed the checksum |",
        "|---:|---:|---:|---:|---:|", *lines,
    ]) + "\n"  # fmt: skip
    if options.record:
        data = {"commit": commit(), "machine": machine(), "polled": polled, "drawn": drawn}
        (RESULTS / f"pedal_noise-{today}.json").write_text(json.dumps(data, indent=1) + "\n")
        (RESULTS / f"pedal_noise-{today}.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
