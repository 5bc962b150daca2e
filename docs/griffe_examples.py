"""The docstrings' `Example:` as a section of code, as the reference reads `Examples:`."""

import re

import griffe


class Examples(griffe.Extension):
    """Renames the section while the package is read."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Of every object that has a docstring."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^(\s*)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
