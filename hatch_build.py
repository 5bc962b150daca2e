"""The README as a package index shows it: no link and no picture may lead to a file beside it, which is not there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_PICTURE = re.compile(r"!\[([^\]]*)\]\((?!\w+:)([^)]+)\)\n*(Made by [^\n]*\n+)?")
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!\w+:)([^)]+)\)")


def for_an_index(text: str, urls: dict[str, str]) -> str:
    """Links to files made absolute below `urls`: "files" for pages, "raw" for pictures; without them, plain text."""
    files, raw = urls.get("files"), urls.get("raw")
    picture = rf"![\1]({raw}/\2)\n\n\3" if raw else ""
    return _LINK.sub(rf"[\1]({files}/\2)" if files else r"\1", _PICTURE.sub(picture, text))


class ReadmeHook(MetadataHookInterface):
    """Fills in `readme`, with the addresses of [tool.hatch.metadata.hooks.custom]."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """As hatch calls it."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": for_an_index(text, self.config)}
