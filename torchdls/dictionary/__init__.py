"""Dictionaries of patches: initial dictionaries, sparse coding, and the learners (SOUP-DIL first among them)."""

from torchdls._registry import LEARNERS
from torchdls.dictionary.denoise import denoise_height
from torchdls.dictionary.focuss import Focuss
from torchdls.dictionary.initial import dct_dictionary
from torchdls.dictionary.learners import KSVD, DinoKat, FixedDictionary, Learner, SoupDIL
from torchdls.dictionary.pursuit import orthogonal_matching_pursuit
from torchdls.dictionary.soup_dil import soup_dil_sweep
from torchdls.dictionary.tiles import TiledSweep, learn_over_tiles, over_ranks
from torchdls.dictionary.unitary import Unitary

__all__ = [
    "KSVD",
    "LEARNERS",
    "DinoKat",
    "FixedDictionary",
    "Focuss",
    "Learner",
    "SoupDIL",
    "TiledSweep",
    "Unitary",
    "dct_dictionary",
    "denoise_height",
    "learn_over_tiles",
    "orthogonal_matching_pursuit",
    "over_ranks",
    "soup_dil_sweep",
]
