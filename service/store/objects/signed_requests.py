"""Requests to an S3-compatible store for what obstore cannot ask: the store's own checksums, and object lock.

They are signed by AWS Signature Version 4 (docs.aws.amazon.com/AmazonS3/latest/API/sig-v4-header-based-auth.html).
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from urllib.parse import quote, urlencode, urlsplit

from service.store.durable_effects import Clock
from service.store.objects.interface import ObjectStoreAwayError

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
