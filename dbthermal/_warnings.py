"""Sentences on what speaks against data that pass, which stay with these."""

import warnings

import xarray as xr

NAME = "warnings"  # attribute, a list of sentences


def warned(dataset: xr.Dataset, *sentences: str) -> xr.Dataset:
    """Dataset with sentences in its attribute ``warnings``; each is a UserWarning, too."""
    known = [*dataset.attrs.get(NAME, [])]
    new = [one for one in dict.fromkeys(sentences) if one not in known]
    for sentence in new:
        warnings.warn(sentence, stacklevel=3)
    return dataset.assign_attrs({NAME: known + new}) if new else dataset
