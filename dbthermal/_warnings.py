"""Warnings that are also stored in a dataset's attributes."""

import warnings
from typing import Final

import xarray as xr

NAME: Final = "warnings"  # attribute, a list of sentences


def warned(dataset: xr.Dataset, *sentences: str) -> xr.Dataset:
    """Dataset with sentences in its attribute ``warnings``; each is a UserWarning, too."""
    for sentence in dict.fromkeys(sentences):
        warnings.warn(sentence, stacklevel=3)
    notes = dict.fromkeys([*dataset.attrs.get(NAME, []), *sentences])
    return dataset.assign_attrs({NAME: [*notes]}) if notes else dataset
