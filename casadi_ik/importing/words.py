"""Names and sentences as YAML takes them, whatever somebody called a link."""

from __future__ import annotations

import json
import re

PLAIN = re.compile(r"[A-Za-z_/.][A-Za-z0-9_./+-]*")
"""What YAML takes for text without quotes; nothing that it could take for anything else."""

RESERVED = {"true", "false", "yes", "no", "on", "off", "null", "y", "n", "."}


def scalar(text: str) -> str:
    """A text as a YAML value or key."""
    if PLAIN.fullmatch(text) and text.lower() not in RESERVED:
        return text
    return json.dumps(text, ensure_ascii=False)


def one_line(text: str) -> str:
    """A text without line ends and what cannot be printed."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
