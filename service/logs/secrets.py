"""Removes secrets from log lines: passwords, PINs, tokens, set-up links and keys."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

OUT = "[secret]"
_NAMES = r"pass(?:word|phrase|wd)?|pin|token|csrf|secret|authorization|cookie|api[_-]?key|private[_-]?key|session"
_NAME = re.compile(rf"(?:\w*_)?(?:{_NAMES})(?:_hash|_sha256)?", re.IGNORECASE)
_PATTERNS = (
    (re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|\Z)", re.DOTALL), OUT),
    (re.compile(r"(/set-up/)[^\s\"'<>/?#{]+"), rf"\1{OUT}"),
    (re.compile(r"(://)[^/\s:@]+:[^/\s@]+@"), rf"\1{OUT}@"),
    (re.compile(r"\$argon2\S+"), OUT),
    # Authorization: Bearer abc; Cookie: a=b; c=d
    (re.compile(r"\b(authorization|(?:set-)?cookie)(\s*[:=]\s*)[^\r\n]+", re.IGNORECASE), rf"\1\2{OUT}"),
    (
        re.compile(rf"\b((?:\w*_)?(?:{_NAMES}))(['\"]?\s*[=:]\s*)(\"[^\"]*\"|'[^']*'|[^\s,;&)}}\]]+)", re.IGNORECASE),
        rf"\1\2{OUT}",
    ),
)


def without_secrets(value: Any, name: str = "") -> Any:
    """A copy of plain data with secrets replaced by `[secret]`, found by field name and by pattern within text."""
    if name and _NAME.fullmatch(name) and value not in (None, "", False, True):
        return OUT
    if isinstance(value, str):
        for pattern, instead in _PATTERNS:
            value = pattern.sub(instead, value)
        return value
    if isinstance(value, Mapping):
        return {str(key): without_secrets(item, str(key)) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_secrets(item) for item in value]
    return value
