"""A small time-stamp authority: generated certificates, answers by `openssl ts`, served on this machine."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

LONGEST_REPLY = 1 << 20  # that is read

_CONFIGURATION = """\
[tsa]
default_tsa = here
[here]
serial = {folder}/serial
signer_digest = sha256
default_policy = 1.2.3.4.1
digests = sha256, sha512
accuracy = secs:1
ess_cert_id_chain = no
ess_cert_id_alg = sha256
"""


@dataclass
class TimeStampAuthority:
    """Its address, the effect of its answers, and how it misbehaves."""

    url: str
    certificates: Path
    behaviour: str = "good"  # good, silent, asleep, dripping, garbage, replay, html, long
    asked: int = 0
    first: bytes = b""
    sent: str = ""  # what the last question said that it was
    lock: threading.Lock = field(default_factory=threading.Lock)
    woken: threading.Event = field(default_factory=threading.Event)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def make_certificates(folder: Path) -> Path:
    """Create a root and a time-stamping certificate signed by it, with its key; returns the root's file."""
    root_key, key = (rsa.generate_private_key(public_exponent=65537, key_size=2048) for _ in range(2))
    begins, ends = datetime.now(UTC) - timedelta(days=1), datetime.now(UTC) + timedelta(days=3650)

    def builder(subject: str, public_key: rsa.RSAPublicKey) -> x509.CertificateBuilder:
        made = x509.CertificateBuilder().subject_name(_name(subject)).issuer_name(_name("Root of the test"))
        made = made.public_key(public_key).serial_number(x509.random_serial_number())
        return made.not_valid_before(begins).not_valid_after(ends)

    root = (
        builder("Root of the test", root_key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(root_key.public_key()), critical=False)
        .sign(root_key, hashes.SHA256())
    )
    leaf = (
        builder("Time stamps of the test", key.public_key())
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.TIME_STAMPING]), critical=True)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(root_key.public_key()), critical=False)
        .sign(root_key, hashes.SHA256())
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    (folder / "leaf.pem").write_bytes(leaf.public_bytes(Encoding.PEM))
    (folder / "root.pem").write_bytes(root.public_bytes(Encoding.PEM))
    (folder / "serial").write_text("01\n")
    (folder / "openssl.cnf").write_text(_CONFIGURATION.format(folder=folder))
    return folder / "root.pem"


def reply(folder: Path, query: bytes) -> bytes:
    """The answer to a query, signed with the certificates in a folder (see `make_certificates`)."""
    (folder / "query").write_bytes(query)
    words = ["openssl", "ts", "-reply", "-config", folder / "openssl.cnf", "-queryfile", folder / "query"]
    words += ["-inkey", folder / "key.pem", "-signer", folder / "leaf.pem", "-out", folder / "reply"]
    subprocess.run(words, check=True, capture_output=True, timeout=30)
    return (folder / "reply").read_bytes()


@contextmanager
def time_stamp_authority(folder: Path) -> Generator[TimeStampAuthority]:
    """Run an authority on a free port while the block runs."""
    root = make_certificates(folder)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            query = self.rfile.read(int(self.headers["Content-Length"]))
            with authority.lock:
                authority.asked += 1
                authority.sent = str(self.headers["Content-Type"])
                answer = reply(folder, query)
                authority.first = authority.first or answer
            kind = "text/html" if authority.behaviour == "html" else "application/timestamp-reply"
            other = {
                "garbage": b"\x30\x03\x02\x01\x00",
                "replay": authority.first,
                "long": answer + bytes(LONGEST_REPLY),
            }
            content = other.get(authority.behaviour, answer)
            if authority.behaviour == "silent":
                return
            if authority.behaviour == "asleep":
                authority.woken.wait(30)
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            for byte in content if authority.behaviour == "dripping" else ():
                self.wfile.write(bytes([byte]))
                if authority.woken.wait(0.05):
                    return
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # its name in the base class
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        authority = TimeStampAuthority(f"http://127.0.0.1:{server.server_port}/tsa", root)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield authority
        finally:
            authority.woken.set()
            server.shutdown()
            thread.join()
