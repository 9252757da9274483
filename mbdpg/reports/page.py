"""One HTML file that shows runs side by side, offline, and in which nothing that was read from them can act.

Content is JSON, which the page's own script puts into text nodes. The policy allows that script and style, by their
hashes, and embedded videos; everything else, the network above all, is refused by the browser.
"""

from __future__ import annotations

import base64
import hashlib
import json
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from mbdpg.interfaces import UserError
from mbdpg.storage.files import replace_durably

_ESCAPES = str.maketrans({sign: f"\\u{ord(sign):04x}" for sign in "<>&\u2028\u2029"})
"""In JSON these stand in strings alone, so a parser gives them back; no HTML parser sees an end of the block."""


def write_page(path: Path, content: dict[str, Any]) -> None:
    """Write the page; whoever looks meanwhile sees the old one or the new one.

    Args:
        path: its file.
        content: as `mbdpg.reports.contents.contents` returns it.

    Raises:
        UserError: it cannot be written.
    """
    try:
        replace_durably(path, page(content).encode())
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def page(content: dict[str, Any]) -> str:
    """The page's HTML."""
    style, script = _asset("page.css"), _asset("chart.js") + _asset("page.js")
    policy = (
        f"default-src 'none'; script-src {_source(script)}; style-src {_source(style)}; media-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    data = json.dumps(content, allow_nan=False).translate(_ESCAPES)
    return Template(_asset("page.html")).substitute(policy=policy, style=style, script=script, data=data)


def _source(text: str) -> str:
    """What the policy calls an inline text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _asset(name: str) -> str:
    return resources.files("mbdpg.reports").joinpath(name).read_text(encoding="utf-8")
