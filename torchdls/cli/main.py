"""The command line: `torchdls integrate`, `view`, `batch`, `photometric`, `demo`, `methods`.

PyTorch is imported when a command runs, so `torchdls --help` answers at once. Whatever is wrong with a file or an
argument is one line on standard error and exit status 2; output files are written whole or not at all.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence

from torchdls import __version__
from torchdls.cli.batch import add_batch
from torchdls.cli.demo import add_demo
from torchdls.cli.integrate import add_integrate
from torchdls.cli.methods import list_methods
from torchdls.cli.photometric import add_photometric
from torchdls.cli.pictures import add_view

_EXAMPLES = """\
examples:
  torchdls demo --out demo
  torchdls integrate normals.png --convention directx --mask mask.png -o surface.ply -o height.tiff
  torchdls integrate gradient.npz --method least_squares -o height.npz
  torchdls integrate normals.png --convention opencv --camera K.txt -o depth.tiff
  torchdls integrate FOLDER -o surface.npz -o view.html -o preview.png
  torchdls view surface.npz
  torchdls photometric photographs --normals normals.png -o surface.ply
  torchdls batch maps/ --out surfaces --format npz,ply --convention directx
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 1 if maps failed, 2 for bad input, 130 when interrupted."""
    # Threads that wait shall sleep: two processes of two threads on two cores otherwise take many times longer.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when PyTorch is loaded
    arguments = _parser().parse_args(argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            status = int(arguments.run(arguments) or 0)
        sys.stdout.flush()
    except (ValueError, TypeError, OSError, ImportError) as error:
        return _complain(error)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "allocate memory" in str(error):
            return _complain(OSError("there is not enough memory for an input of this size"))
        raise
    except KeyboardInterrupt:
        print("torchdls: interrupted", file=sys.stderr)
        return 130
    return status


def _warn(message: Warning | str, *where: object, **more: object) -> None:
    """A warning of the library as one line, without the place in the code."""
    print(f"torchdls: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _complain(error: Exception) -> int:
    if isinstance(error, BrokenPipeError):  # the reader of our output went away, as in `torchdls methods | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    if isinstance(error, OSError) and error.strerror:
        message = f"{error.filename or 'standard output'}: {error.strerror}"
    else:
        message = " ".join(str(error).split()) or type(error).__name__
    message = "".join(c if c.isprintable() else "?" for c in message)
    print(f"torchdls: error: {message if len(message) < 1000 else message[:1000] + ' ...'}", file=sys.stderr)
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchdls",
        description="Surfaces from noisy gradients and normal maps, by dictionary learning (DLS) and its peers.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"torchdls {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    add_integrate(commands)
    add_photometric(commands)
    add_batch(commands)
    add_view(commands)
    add_demo(commands)
    methods = commands.add_parser("methods", help="list the methods", description="List the methods and their options.")
    methods.set_defaults(run=list_methods)
    return parser
