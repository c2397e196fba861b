"""The adapter to S3-compatible object stores: obstore for content, signed requests for what the store states."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import http.client
import mmap
import re
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, urlencode, urlsplit

from service.core.errors import ConfigurationError, IntegrityError, StoreError
from service.store.artefacts import Meter
from service.store.data_folder import file_mode
from service.store.durable_effects import Clock
from service.store.objects.interface import ObjectStoreAwayError, ObjectStoreError, StoredObject

if TYPE_CHECKING:
    from obstore.store import ClientConfig, S3Store

# Requests to an S3-compatible store for what obstore cannot ask: the store's own checksums, and object lock.
#
# They are signed by AWS Signature Version 4 (docs.aws.amazon.com/AmazonS3/latest/API/sig-v4-header-based-
# auth.html).


TIMEOUT_S = 20.0


@dataclass(frozen=True, slots=True)
class StoreKeys:
    """The keys of an object store; they are never printed."""

    access_key_id: str
    secret_access_key: str

    def __repr__(self) -> str:
        return "StoreKeys(…)"


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one request: status, headers in lower case, and body."""

    status: int
    headers: Mapping[str, str]
    body: bytes


def _digest(key: bytes, text: str) -> bytes:
    return hmac.digest(key, text.encode(), "sha256")


def signed_headers(
    keys: StoreKeys,
    region: str,
    at: datetime,
    method: str,
    url: str,
    headers: Mapping[str, str],
    body: bytes,
) -> dict[str, str]:
    """Return the headers of a request with its signature. All that are given are signed."""
    parts = urlsplit(url)
    stamp, day = f"{at:%Y%m%dT%H%M%SZ}", f"{at:%Y%m%d}"
    every = {
        **{name.lower(): value for name, value in headers.items()},
        "host": parts.netloc,
        "x-amz-content-sha256": hashlib.sha256(body).hexdigest(),
        "x-amz-date": stamp,
    }
    names = ";".join(sorted(every))
    lines = "".join(f"{name}:{every[name].strip()}\n" for name in sorted(every))
    request = "\n".join([method, parts.path, parts.query, lines, names, every["x-amz-content-sha256"]])
    scope = f"{day}/{region}/s3/aws4_request"
    to_sign = "\n".join(["AWS4-HMAC-SHA256", stamp, scope, hashlib.sha256(request.encode()).hexdigest()])
    key = f"AWS4{keys.secret_access_key}".encode()
    for part in (day, region, "s3", "aws4_request"):
        key = _digest(key, part)
    signature = _digest(key, to_sign).hex()
    credential = f"{keys.access_key_id}/{scope}"
    every["authorization"] = f"AWS4-HMAC-SHA256 Credential={credential}, SignedHeaders={names}, Signature={signature}"
    return every


class SignedRequests:
    """Sends signed requests to the objects of one bucket, or to the bucket itself."""

    def __init__(self, endpoint: str, bucket: str, region: str, keys: StoreKeys, clock: Clock) -> None:
        self._endpoint, self._bucket, self._region, self._keys, self._clock = endpoint, bucket, region, keys, clock

    def send(
        self,
        method: str,
        key: str = "",
        *,
        query: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
        body: bytes = b"",
    ) -> Answer:
        """Send a request and return the answer, whatever its status. Raises ObjectStoreAwayError without one."""
        asked = urlencode(sorted((query or {}).items()), quote_via=quote)
        path = f"/{quote(self._bucket)}" + (f"/{quote(key)}" if key else "")
        url = f"{self._endpoint.rstrip('/')}{path}" + (f"?{asked}" if asked else "")
        parts = urlsplit(url)
        at = self._clock.utc_now()
        signed = signed_headers(self._keys, self._region, at, method, url, headers or {}, body)
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        connection = kind(parts.netloc, timeout=TIMEOUT_S)
        try:
            connection.request(method, f"{parts.path}?{parts.query}" if parts.query else parts.path, body, signed)
            answer = connection.getresponse()
            content = answer.read()
        except (OSError, http.client.HTTPException) as error:
            raise ObjectStoreAwayError(
                f"the object store does not answer: {error or type(error).__name__}", where=self._endpoint
            ) from error
        finally:
            connection.close()
        return Answer(answer.status, {name.lower(): value for name, value in answer.getheaders()}, content)


MOST_BYTES = 5 * 1024**3  # one request of S3 takes no more; parts would have no SHA-256 of the whole
_SHA256 = re.compile(r"[0-9a-f]{64}")
_CHUNK_BYTES = 1 << 20
_REMEDY = "Check object_store in site.yaml, its keys and their rights: `orthocapture doctor` probes the store"
_OTHER_CONTENT = "The store or somebody with its keys changed it; restore the file from a backup"


def _installed() -> bool:
    try:
        return find_spec("obstore") is not None
    except ValueError:  # its place in sys.modules is blocked
        return False


def require_obstore() -> None:
    """Raise ConfigurationError unless the package obstore is installed."""
    if not _installed():
        raise ConfigurationError(
            "site.yaml names an object store, and the package obstore is not installed",
            where="object_store",
            remedy='Install it with `pip install "orthocapture[site]"`',
        )


class S3Objects:
    """Objects below a prefix of a bucket, named ab/abcdef… by their SHA-256."""

    def __init__(
        self, *, endpoint: str, bucket: str, prefix: str, region: str, keys: StoreKeys, clock: Clock
    ) -> None:
        require_obstore()
        from obstore.store import S3Store  # noqa: PLC0415 - an optional package

        self._bucket = bucket
        self._place = f"s3://{bucket}/{prefix}".rstrip("/") + f" at {endpoint}"
        self._prefix = prefix.strip("/")
        self.requests = SignedRequests(endpoint, bucket, region, keys, clock)
        options: ClientConfig = {
            "allow_http": endpoint.startswith("http://"),
            "timeout": "300s",
            "connect_timeout": "5s",
        }
        self._store: S3Store = S3Store(
            bucket,
            endpoint=endpoint,
            region=region,
            access_key_id=keys.access_key_id,
            secret_access_key=keys.secret_access_key,
            checksum_algorithm="sha256",
            virtual_hosted_style_request=False,
            client_options=options,
            retry_config={"max_retries": 1},  # whoever calls tries again, with growing pauses
        )

    @property
    def place(self) -> str:
        """The name of the place in records and messages, without keys."""
        return self._place

    @property
    def prefix(self) -> str:
        """The prefix of all keys, without a slash at its end; "" for none."""
        return self._prefix

    def key(self, name: str) -> str:
        """Return the key of an object in the bucket."""
        sharded = f"{name[:2]}/{name}"
        return f"{self._prefix}/{sharded}" if self._prefix else sharded

    def require_bucket(self) -> None:
        """Raise ObjectStoreError, with its name, if there is no such bucket: some stores make one at a first put."""
        answer = self.requests.send("HEAD")
        if answer.status == 404:
            raise ObjectStoreError(
                f"the object store has no bucket {self._bucket!r}",
                where=self._place,
                remedy="Correct url in site.yaml, or make the bucket: nothing is put into one that is not there",
            )
        require_success(answer, self._place)

    def put_if_absent(self, sha256: str, path: Path) -> bool:
        """Store a file in one conditional request, unless an object of this name exists. Says whether it was stored.

        Raises IntegrityError if the file does not have this hash, StoreError if it cannot be read.
        """
        try:
            with path.open("rb") as file:
                size = file.seek(0, 2)
                if size == 0:
                    return self._send(sha256, path, b"")
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                    return self._send(sha256, path, content)
        except OSError as error:
            raise StoreError(
                f"a file cannot be read for its upload: {error.strerror or error}", where=str(path)
            ) from error

    def _send(self, sha256: str, path: Path, content: bytes | mmap.mmap) -> bool:
        if len(content) > MOST_BYTES:
            raise ObjectStoreError(
                "an object store takes at most 5 GiB in one request; this file stays in the spool", where=str(path)
            )
        found = hashlib.sha256(content).hexdigest()
        if found != sha256:
            raise IntegrityError(
                f"a stored file was altered: its content is {found}",
                where=str(path),
                remedy="Run `orthocapture audit verify`; restore the file from a copy",
            )
        from obstore import put  # noqa: PLC0415
        from obstore.exceptions import AlreadyExistsError  # noqa: PLC0415

        with self._errors():
            try:
                # A copy: obstore may still hold a view of a mapping when the request has ended.
                put(self._store, self.key(sha256), bytes(content), mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
        return True

    def stat(self, sha256: str) -> StoredObject | None:
        """Return size and SHA-256 that the store states of an object now; None if it has none of this name."""
        answer = self.requests.send("HEAD", self.key(sha256), headers={"x-amz-checksum-mode": "ENABLED"})
        if answer.status == 404:
            return None
        require_success(answer, self._place)
        return StoredObject(
            int(answer.headers.get("content-length", "-1")),
            _hexadecimal(answer.headers.get("x-amz-checksum-sha256", "")),
        )

    def chunks(self, sha256: str) -> Iterator[bytes]:
        """Yield the content of an object as it arrives; nothing is checked. Raises ObjectStoreError."""
        from obstore import get  # noqa: PLC0415

        with self._errors():
            for chunk in get(self._store, self.key(sha256)).stream(_CHUNK_BYTES):
                yield bytes(chunk)

    def fetch(self, sha256: str, to: Path) -> int:
        """Write an object into a new file, for whom its folder is, and return its size in bytes.

        Raises IntegrityError, and leaves no file, if its content is not that of its name.
        """
        meter = Meter(self.chunks(sha256))
        try:
            with to.open("xb") as file:
                to.chmod(file_mode(to.parent))
                file.writelines(meter)
            self._require_content(sha256, meter.sha256)
        except OSError as error:
            to.unlink(missing_ok=True)
            raise StoreError(
                f"a fetched file cannot be written: {error.strerror or error}",
                where=str(to),
                remedy="Make room on the disk of the data folder",
            ) from error
        except BaseException:
            to.unlink(missing_ok=True)
            raise
        return meter.size

    def _require_content(self, sha256: str, found: str) -> None:
        if found != sha256:
            raise IntegrityError(
                f"the object store holds other content under this hash: {found}",
                where=f"{sha256} in {self._place}",
                remedy=_OTHER_CONTENT,
            )

    def list(self) -> Iterator[tuple[str, int]]:
        """Yield name and size in bytes of every object that is named by a hash."""
        from obstore import list as list_objects  # noqa: PLC0415

        with self._errors():
            for page in list_objects(self._store, prefix=self._prefix or None):
                for found in page:
                    name = found["path"].rpartition("/")[2]
                    if _SHA256.fullmatch(name):
                        yield name, found["size"]

    def delete(self, sha256: str) -> None:
        """Delete an object, if it exists and the store lets it be deleted."""
        from obstore import delete  # noqa: PLC0415

        with self._errors(), suppress(FileNotFoundError):
            delete(self._store, self.key(sha256))

    @contextmanager
    def _errors(self) -> Generator[None]:
        from obstore.exceptions import (  # noqa: PLC0415
            BaseError,
            PermissionDeniedError,
            UnauthenticatedError,
        )

        try:
            yield
        except FileNotFoundError as error:
            raise ObjectStoreError(
                "the object store has no such object, or no such bucket", where=self._place, remedy=_REMEDY
            ) from error
        except (PermissionDeniedError, UnauthenticatedError) as error:
            raise ObjectStoreError(
                f"the object store refused: {_first_line(error)}", where=self._place, remedy=_REMEDY
            ) from error
        except BaseError as error:
            raise ObjectStoreAwayError(
                f"the object store does not answer as it should: {_first_line(error)}", where=self._place
            ) from error


def require_success(answer: Answer, place: str) -> None:
    """Raise ObjectStoreError for an answer that refuses, ObjectStoreAwayError for one that says: not now."""
    if answer.status < 300:
        return
    kind = ObjectStoreAwayError if answer.status >= 500 or answer.status == 429 else ObjectStoreError
    code = re.search(rb"<Code>([^<]*)</Code>", answer.body)
    said = f" {code.group(1).decode(errors='replace')}" if code else ""
    raise kind(f"the object store refused with status {answer.status}{said}", where=place, remedy=_REMEDY)


def _hexadecimal(base64_text: str) -> str:
    """Return a checksum as hexadecimal; "" for anything that is not the SHA-256 of a whole object."""
    try:
        raw = base64.b64decode(base64_text, validate=True)
    except (binascii.Error, ValueError):
        return ""
    return raw.hex() if len(raw) == 32 else ""


def _first_line(error: Exception) -> str:
    """Return what a library said, without the pages of its debugging output."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]
