"""Warnings that are also stored in a dataset's attributes."""

import warnings

import xarray as xr


def warned(dataset: xr.Dataset, *sentences: str) -> xr.Dataset:
    """Dataset with sentences in its attribute ``warnings``; each is a UserWarning, too."""
    for sentence in dict.fromkeys(sentences):
        warnings.warn(sentence, stacklevel=3)
    notes = dict.fromkeys([*dataset.attrs.get("warnings", []), *sentences])
    return dataset.assign_attrs(warnings=[*notes]) if notes else dataset
