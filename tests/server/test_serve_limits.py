"""`orthocapture serve` against hostile clients: who is shut out, what it costs, what is logged."""

from __future__ import annotations

import resource
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import psutil
import pytest

from service.core.records.events import SignInRecorded
from service.store.records import SITE
from service.store.store import Store
from service.web.connections import OpenStream, OpenStreams
from tests.support.pages.certificates import self_signed
from tests.support.pages.serving import Server, serving
from tests.support.processes.waiting import until
from tests.support.rig.rig import orthocapture
from tests.support.runs.bench_run import PROTOCOL, begin_run

HALF = b"GET /account HTTP/1.1\r\nHost: localhost\r\n"
WAIT_S = 60.0  # for what takes no time on an idle machine
WHOLE = b"GET /sign-in HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text("name: a small site\nsimulated: true\ndevices: {}\n")
    return path


@contextmanager
def clients(server: Server, count: int, sent: bytes, *, source: str = "127.0.0.1") -> Generator[list[socket.socket]]:
    """Open `count` connections, on each of which the same bytes are sent."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 4096)), hard))
    with ExitStack() as stack:
        opened: list[socket.socket] = []
        for _ in range(count):
            client = socket.create_connection(server.address, timeout=WAIT_S, source_address=(source, 0))
            opened.append(stack.enter_context(client))
            with suppress(OSError):  # the server may have closed it already
                client.sendall(sent)
        yield opened


def is_over(client: socket.socket, *, within_s: float = 0.0) -> bool:
    """Whether the server closes the connection; what it sends before is discarded."""
    client.settimeout(max(within_s, 0.001))
    try:
        while client.recv(65536):
            pass
    except TimeoutError:
        return False
    except OSError:
        return True
    return True


def ports_of_clients(server: Server) -> set[int]:
    """The clients' ports of the connections that the server has."""
    connections = psutil.Process(server.process.pid).net_connections(kind="tcp")
    return {each.raddr.port for each in connections if each.raddr}


def dribbles_in_vain(client: socket.socket, *, within_s: float) -> bool:
    """Whether the server closes the connection although a byte arrives every fifth of a second."""
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        if is_over(client, within_s=0.2):
            return True
        with suppress(OSError):
            client.sendall(b"a")
    return False


# --- connections ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_1100_half_open_requests_shut_nobody_out_and_are_told_in_a_few_lines(rig: Path) -> None:
    with serving(rig, most_files=1024) as server:
        person = server.signed_in()
        with clients(server, 1100, HALF) as opened:
            for _ in range(3):
                assert httpx.get(f"{server.url}/account", headers=person, timeout=WAIT_S).status_code == 200
                assert httpx.get(f"{server.url}/sign-in", timeout=WAIT_S).status_code == 200
            assert sum(not is_over(client) for client in opened) <= 64
            assert psutil.Process(server.process.pid).num_fds() < 200
        assert 0 < server.log.stat().st_size < 2000
    assert "more messages like this were left out" in server.log.read_text()


@pytest.mark.slow
def test_one_address_leaves_room_for_others(rig: Path) -> None:
    with (
        serving(rig, "--connections", "12", "--address-connections", "8", "--client-wait-s", "300") as server,
        clients(server, 20, HALF) as here,
        clients(server, 20, HALF, source="127.0.0.2") as there,
    ):
        until(lambda: sum(not is_over(client) for client in (*here, *there)) == 12, "the others leave", WAIT_S)
        left = [client for client in (*here, *there) if not is_over(client)]
        assert left == [*here[-5:], *there[-7:]]  # the newest of both
        assert httpx.get(f"{server.url}/sign-in", timeout=WAIT_S).status_code == 200


def test_a_client_that_is_slow_on_purpose_is_left(rig: Path) -> None:
    body = b"POST /sign-in HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/x-www-form-urlencoded\r\n"
    with serving(rig, "--client-wait-s", "3") as server, ExitStack() as stack:
        silent, half, idle, promised, stalled = (
            stack.enter_context(clients(server, 1, sent))[0]
            for sent in (b"", HALF + b"X: ", WHOLE, body + b"Content-Length: 99\r\n\r\naccount=a", b"")
        )
        stalled.sendall(b"GET /vendor/plotly.js HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert dribbles_in_vain(half, within_s=WAIT_S)
        assert is_over(silent, within_s=WAIT_S)
        promised.settimeout(WAIT_S)
        assert b"HTTP/1.1 408" in promised.recv(65536)
        assert is_over(promised, within_s=WAIT_S)
        assert idle.recv(20).startswith(b"HTTP/1.1 200")
        assert dribbles_in_vain(idle, within_s=WAIT_S)  # before uvicorn's own five seconds, which each byte restarts
        port = stalled.getsockname()[1]
        until(lambda: port not in ports_of_clients(server), "the stalled client is kept")
        stalled.settimeout(WAIT_S)
        head, _, taken = stalled.recv(65536).partition(b"\r\n\r\n")
        promised_bytes = int(head.lower().partition(b"content-length: ")[2].split()[0])
        taken_bytes = len(taken)
        with suppress(OSError):
            while piece := stalled.recv(1 << 20):
                taken_bytes += len(piece)
        assert taken_bytes < promised_bytes
        assert httpx.get(f"{server.url}/sign-in", timeout=WAIT_S).status_code == 200


def test_a_client_that_never_begins_tls_is_left(rig: Path) -> None:
    certificate, key = self_signed(rig.parent)
    files = ("--tls-certificate", str(certificate), "--tls-key", str(key))
    with serving(rig, *files, "--client-wait-s", "3") as server, clients(server, 1, b"") as (silent,):
        assert is_over(silent, within_s=WAIT_S)
        trust = ssl.create_default_context(cafile=str(certificate))
        assert httpx.get(f"{server.url}/sign-in", timeout=WAIT_S, verify=trust).status_code == 200


@pytest.mark.slow
@pytest.mark.realtime
def test_when_no_more_files_can_be_opened_it_neither_spins_nor_floods_the_log(rig: Path) -> None:
    with serving(rig) as server:
        assert httpx.get(f"{server.url}/sign-in", timeout=WAIT_S).status_code == 200
        process = psutil.Process(server.process.pid)
        usual = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (process.num_fds() + 3, usual[1]))
        with clients(server, 60, HALF):
            with subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) as spinning:
                reference = psutil.Process(spinning.pid)
                before_s = cpu_s(process)
                until(lambda: cpu_s(reference) > 1.0, "this machine computes nothing")
                spinning.kill()
            assert cpu_s(process) - before_s < 0.4, "less than half of what a process takes that spins"
            resource.prlimit(process.pid, resource.RLIMIT_NOFILE, usual)
            assert httpx.get(f"{server.url}/sign-in", timeout=WAIT_S).status_code == 200
        log = server.log.read_text()
    assert log.count("out of system resource") == 1
    assert len(log) < 10_000  # a traceback or two; the flood was megabytes per second


def cpu_s(process: psutil.Process) -> float:
    return sum(process.cpu_times()[:2])


def test_what_is_no_http_is_told_once_and_counted(rig: Path) -> None:
    with serving(rig) as server:
        for _ in range(50):
            with clients(server, 1, b"\x16\x03\x01 not http\r\n\r\n") as (client,):
                assert is_over(client, within_s=WAIT_S)
        assert server.log.read_text().count("Invalid HTTP request") == 1
    assert "49 more messages like this were left out: Invalid HTTP request" in server.log.read_text()


# --- streams of news -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sign_in_has_six_streams_the_newest_and_strangers_do_not_end_them(rig: Path) -> None:
    with Store.open(rig.parent / "data") as store:
        run_id = begin_run(store, PROTOCOL, rig.parent).run_id
    with serving(rig) as server:
        person = server.signed_in()
        asked = f"GET /runs/{run_id}/stream HTTP/1.1\r\nHost: localhost\r\nCookie: {person['Cookie']}\r\n\r\n"
        streams: list[socket.socket] = []
        with ExitStack() as stack:
            for _ in range(30):
                client = stack.enter_context(socket.create_connection(server.address, timeout=WAIT_S))
                client.sendall(asked.encode())
                heard = b""
                while b"event: changed" not in heard:  # each one gets the news, however many there were before
                    piece = client.recv(4096)
                    assert piece, heard
                    heard += piece
                streams.append(client)
            for client in streams[:24]:
                heard = b""
                while not heard.endswith(b"0\r\n\r\n"):  # the end of the answer
                    heard += client.recv(4096)
                assert b"event: replaced" in heard
            stack.enter_context(clients(server, 200, HALF))
            for client in streams[24:]:
                client.settimeout(WAIT_S)
                assert b"event:" in client.recv(4096)
            assert not any(is_over(client) for client in streams[24:])


def test_of_all_streams_the_one_that_has_most_gives_way() -> None:
    streams = OpenStreams(per_screen=3, in_all=5)
    opened: list[OpenStream] = []
    with ExitStack() as stack:
        for screen in ("A", "B", "B", "B", "C", "D"):
            opened.append(stack.enter_context(streams.opened(screen)))
        assert [stream.replaced for stream in opened] == [False, True, False, False, False, False]
        opened.append(stack.enter_context(streams.opened("E")))
        assert [stream.screen for stream in opened if stream.replaced] == ["B", "B"]
    with streams.opened("A") as alone:
        assert not alone.replaced


# --- addresses -----------------------------------------------------------------------------------------------


def recorded_addresses(rig: Path) -> list[str]:
    with Store.open(rig.parent / "data") as store:
        payloads = [event.payload for event in store.events(SITE)]
    return [each.address for each in payloads if isinstance(each, SignInRecorded) and each.outcome == "refused"]


@pytest.mark.slow
def test_a_forwarded_address_passes_no_limit_stands_in_no_record_and_a_restart_forgives_nothing(rig: Path) -> None:
    with serving(rig) as server:
        answers = [
            server.refused_sign_in(f"guess{n}", [("X-Forwarded-For", f"198.51.100.{n}")]).status_code
            for n in range(21)
        ]
        assert answers == [401] * 20 + [429]
    assert recorded_addresses(rig) == ["127.0.0.1"] * 20
    with serving(rig) as server:
        refused = server.refused_sign_in("guess", [("X-Forwarded-For", "198.51.100.99")])
        assert refused.status_code == 429
        assert 0 < int(refused.headers["retry-after"]) <= 300


def test_of_a_trusted_proxys_words_the_last_stranger_counts(rig: Path) -> None:
    with serving(rig, "--trusted-proxy", "127.0.0.1", "--trusted-proxy", "2001:db8::5") as server:
        for forwarded in (
            ["6.6.6.6, 198.51.100.7"],
            ["6.6.6.6", "198.51.100.8:4711, [2001:0DB8::5]:80"],  # two lines, and a second proxy of ours
            ["6.6.6.6, nonsense"],
            ["::ffff:198.51.100.9"],
            [],
        ):
            words = [("X-Forwarded-For", each) for each in forwarded]
            assert server.refused_sign_in("guess", words).status_code == 401
    assert recorded_addresses(rig) == ["198.51.100.7", "198.51.100.8", "127.0.0.1", "198.51.100.9", "127.0.0.1"]


def test_a_proxy_is_an_address(rig: Path) -> None:
    refused = orthocapture("serve", "--rig", str(rig), "--data", str(rig.parent / "data"), "--trusted-proxy", "proxy")
    assert refused.returncode == 1
    assert "'proxy' is not an address" in refused.stderr


def test_the_list_of_addresses_is_not_public(rig: Path) -> None:
    with serving(rig) as server:
        for address in ("/openapi.json", "/docs", "/redoc"):
            assert httpx.get(server.url + address, timeout=WAIT_S).status_code == 404
