"""Surfaces from gradients in PyTorch: DLS and its peers, batched and differentiable.

Every public name imports from here. The names are listed once, in the stub `__init__.pyi` beside this file, which
type checkers and editors read too. Each loads its module on first use, so that ``import torchdls`` and
``torchdls --help`` answer at once.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, _, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_names]


def __dir__() -> list[str]:
    return sorted(__all__)
