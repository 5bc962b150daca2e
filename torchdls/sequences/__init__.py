"""Sequences of gradient fields: many frames together, or one after the other with what was learned before."""

from torchdls.sequences.low_rank import SequenceDLS, SequenceResult
from torchdls.sequences.online import OnlineDLS
from torchdls.sequences.patches import SequencePatches

__all__ = ["OnlineDLS", "SequenceDLS", "SequencePatches", "SequenceResult"]
