"""The command line `torchdls`."""

from torchdls.cli.main import main

__all__ = ["main"]
