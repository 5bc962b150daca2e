"""Dictionaries of patches: initial dictionaries and the SOUP-DIL sweep that learns them."""

from torchdls.dictionary.initial import dct_dictionary
from torchdls.dictionary.soup_dil import soup_dil_sweep

__all__ = ["dct_dictionary", "soup_dil_sweep"]
