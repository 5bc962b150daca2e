"""Surfaces larger than memory: memory-mapped arrays in and out, memory bounded by an option."""

from torchdls.large.integrate import LargeResult, integrate

__all__ = ["LargeResult", "integrate"]
