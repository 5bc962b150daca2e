"""Docstrings as the reference reads them: `Example:` as a section of code, and equations as plain text."""

import re

import griffe


class Examples(griffe.Extension):
    """Renames the section, and writes sums and the like without backslashes, while the package is read."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Of every object that has a docstring."""
        if obj.docstring is not None:
            value = re.sub(r"^(\s*)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = re.sub(r"\\(sum|sqrt|pi|sin|cos|min|max)(?![a-z])", r"\1", value)
