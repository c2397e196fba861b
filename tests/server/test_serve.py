"""`orthocapture serve` as its user meets it: who may reach it, how it starts, how it ends."""

from __future__ import annotations

import json
import os
import socket
import ssl
from contextlib import suppress
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import httpx
import pytest

from service.core.records.events import ServiceStarted
from service.store.records import SITE
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.certificates import self_signed
from tests.support.pages.serving import serving
from tests.support.rig.rig import orthocapture


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text("name: a small site\nsimulated: true\ndevices: {}\n")
    return path


@pytest.mark.slow
def test_it_serves_this_machine_records_its_start_and_signs_at_its_end(rig: Path) -> None:
    with serving(rig) as server:
        assert server.url.startswith("http://127.0.0.1:")
        with urlopen(server.url + "/sign-in", timeout=60) as page:
            assert page.status == 200
            assert "default-src 'none'" in page.headers["Content-Security-Policy"]
        # A page whose foreign host name was made to resolve to this machine (DNS rebinding) gets nothing.
        with pytest.raises(HTTPError) as refused:
            urlopen(Request(server.url + "/sign-in", headers={"Host": "evil.example"}), timeout=60)
        assert refused.value.code in (400, 403, 421)
        refused.value.close()  # it holds the connection, which a search for garbage would find in some later test
        words = ("serve", "--rig", str(rig), "--port", server.url.rpartition(":")[2])
        again = orthocapture(*words, "--data", str(rig.parent / "other"))
        assert again.returncode == 1
        assert "cannot listen" in again.stderr
    data = rig.parent / "data"
    with Store.open(data) as store:
        starts = [e.payload for e in store.events(SITE) if isinstance(e.payload, ServiceStarted)]
        assert len(starts) == 1
        assert starts[0].address == server.url
        assert store.checkpoints(SITE)[-1].seq == store.head(SITE)
    report = verify(data, SITE)
    assert report.ok, report.first_fault
    assert report.unsigned_events == {SITE: 0}


def test_a_second_server_of_a_folder_says_who_serves_it_and_changes_nothing(rig: Path) -> None:
    data = rig.parent / "data"
    words = ("serve", "--rig", str(rig), "--data", str(data), "--port", "0")
    with serving(rig) as server:
        with Store.open(data) as store:
            before = store.head(SITE)
        again = orthocapture(*words)
        assert again.returncode == 1
        told = " ".join(again.stderr.split())
        assert f"another server is using this data folder: process {server.process.pid} of " in told
        assert f"where: {server.url}" in told
        assert ", since " in told
        assert f"Open {server.url} in a browser, or end that server first" in told
        refused = json.loads(orthocapture(*words, "--json").stdout)["error"]
        assert refused["where"] == server.url
        with Store.open(data) as store:
            assert store.head(SITE) == before
        with urlopen(server.url + "/sign-in", timeout=60) as page:
            assert page.status == 200


def test_a_server_that_was_killed_keeps_no_other_from_serving(rig: Path) -> None:
    with suppress(AssertionError), serving(rig) as server:  # its exit status is that of the signal
        server.process.kill()
        server.process.wait(timeout=60)
    assert "127.0.0.1" in (rig.parent / "data" / "serving.json").read_text(), "it could not take that back"
    with serving(rig) as next_one, urlopen(next_one.url + "/sign-in", timeout=60) as page:
        assert page.status == 200
    assert (rig.parent / "data" / "serving.json").read_bytes() == b""


@pytest.mark.slow
def test_it_serves_while_the_second_place_of_the_signatures_is_away(rig: Path) -> None:
    rig.write_text(rig.read_text() + 'signature_copy: "[gone]/[/mnt]/signatures.jsonl"\n')
    copy = rig.parent / "[gone]" / "[" / "mnt]" / "signatures.jsonl"
    with serving(rig) as server:
        who = server.signed_in()
        page = httpx.get(server.url, headers=who, timeout=60).text
        assert "The second place of the signatures is not up to date" in page
        copy.parent.mkdir(parents=True)
        server.refused_sign_in("ada")  # is signed, and the place is tried again
        assert "second place" not in httpx.get(server.url, headers=who, timeout=60).text
    assert copy.read_bytes() == (rig.parent / "data" / "signatures.jsonl").read_bytes()
    assert "[gone]/[/mnt]/signatures.jsonl" in server.log.read_text()


@pytest.mark.slow
def test_it_serves_while_the_second_place_hangs(rig: Path) -> None:
    rig.write_text(rig.read_text() + "signature_copy: share.jsonl\n")
    os.mkfifo(rig.parent / "share.jsonl")
    with serving(rig) as server:
        page = httpx.get(server.url, headers=server.signed_in(), timeout=60).text
        assert "The second place of the signatures is not up to date" in page
        assert "it has not answered for 3 s" in page


def test_other_machines_are_served_with_tls_or_on_an_explicit_word_only(rig: Path) -> None:
    data = str(rig.parent / "data")
    refused = orthocapture("serve", "--rig", str(rig), "--data", data, "--host", "0.0.0.0", "--port", "0", "--json")
    assert refused.returncode == 1
    assert "--insecure-lan" in refused.stdout
    assert not (rig.parent / "data").exists()
    with serving(rig, "--host", "0.0.0.0", "--insecure-lan") as server:
        port = server.url.rpartition(":")[2]
        with urlopen(f"http://127.0.0.1:{port}/sign-in", timeout=60) as page:
            assert page.status == 200


def test_tls(rig: Path) -> None:
    certificate, key = self_signed(rig.parent)
    options = ("--host", "0.0.0.0", "--tls-certificate", str(certificate), "--tls-key", str(key))
    with serving(rig, *options) as server:
        port = server.url.rpartition(":")[2]
        assert server.url.startswith("https://")
        trust = ssl.create_default_context(cafile=str(certificate))
        with urlopen(f"https://127.0.0.1:{port}/sign-in", timeout=60, context=trust) as page:
            assert page.status == 200
        with socket.create_connection(("127.0.0.1", int(port)), timeout=60) as plain:
            plain.sendall(b"GET /sign-in HTTP/1.0\r\n\r\n")
            answer = b""
            with suppress(ConnectionResetError):  # the server may end the connection before it has read everything
                answer = plain.recv(64)
            assert b"200" not in answer
    half = orthocapture("serve", "--rig", str(rig), "--data", str(rig.parent / "data"), "--tls-key", str(key))
    assert half.returncode == 1
    assert "certificate and its key" in half.stderr
