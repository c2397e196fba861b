"""The process that listens to FRI: `python -m drivers.kuka.fri HOST PORT`; a process of its own, to answer in time.

It writes one record for each message to its standard output, and ends when its standard input does.
"""

from __future__ import annotations

import gc
import select
import socket
import sys
import time

from drivers.kuka.fri.listener import Listener

READY = b"ready\n"


def main(host: str, port: int) -> int:
    """Listen until the driver is gone; returns the exit status."""
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind((host, port))
    except OSError as error:
        sys.stdout.write(f"UDP port {port} of {host or 'this machine'}: {error.strerror}\n")
        return 1
    out = sys.stdout.buffer
    out.write(READY)
    out.flush()
    listener = Listener()
    gc.disable()  # a collection would delay a reply; nothing here makes cycles
    while True:
        readable, _, _ = select.select([udp, sys.stdin], [], [])
        if sys.stdin in readable:
            return 0
        datagram, sender = udp.recvfrom(65536)
        answer, sample = listener.take(datagram, sender, time.monotonic())
        if answer is not None:
            udp.sendto(answer, sender)
        if sample is not None:
            try:
                out.write(sample.pack())
                out.flush()
            except BrokenPipeError:
                return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
