"""Readers give a file's contents in SI units, and refuse inconsistent files."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hostile_files import ecostress, written
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from refused import refused

from dbthermal import readers
from reproduction import libraries


def library_file(
    folder: Path, wavelength: Sequence[float], reflectance: Sequence[float], newline: str = "\n"
) -> Path:
    """Write a spectrum as the library does."""
    return written(folder / "glass.spectrum.txt", ecostress(wavelength, reflectance, newline))


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("step", [1, -1])
def test_ecostress_is_kirchhoff_over_increasing_metres(
    tmp_path: Path, step: int, newline: str
) -> None:
    """Either order of wavelengths and either line end give 1 - R/100 over increasing metres."""
    wavelength, reflectance = [8.0, 9.5, 14.0], [5.0, 20.0, 10.0]
    path = library_file(tmp_path, wavelength[::step], reflectance[::step], newline)
    spectrum = readers.ecostress(path)
    assert_allclose(spectrum["wavelength"], [8e-6, 9.5e-6, 14e-6], rtol=0, atol=1e-12)
    assert_allclose(spectrum["emissivity"], [0.95, 0.80, 0.90], rtol=0, atol=1e-12)
    assert spectrum["wavelength"].attrs["units"] == "m"
    assert spectrum["emissivity"].attrs["units"] == "1"


@given(reflectance=st.lists(st.floats(-5, 120), min_size=2, max_size=30), start=st.floats(0.3, 15))
def test_ecostress_round_trip(reflectance: list[float], start: float) -> None:
    """A written spectrum is read back to the four digits of the file."""
    wavelength = [start + 0.1 * step for step in range(len(reflectance))]
    with TemporaryDirectory() as folder:
        spectrum = readers.ecostress(library_file(Path(folder), wavelength, reflectance))
    assert_allclose(spectrum["wavelength"] * 1e6, wavelength, rtol=0, atol=6e-5)
    assert_allclose(100 - 100 * spectrum["emissivity"], reflectance, rtol=0, atol=6e-5)


def test_ecostress_notes(tmp_path: Path) -> None:
    """The header's text is kept, also in Latin-1; missing entries are empty.

    Reflectances of -1 % and 116 % are the instrument's calibration, neither clipped nor lost.
    """
    spectrum = readers.ecostress(library_file(tmp_path, [8, 9, 10], [-1.0, 50.0, 116.0]))
    assert_allclose(spectrum["emissivity"], [1.01, 0.5, -0.16], rtol=0, atol=1e-12)
    notes = spectrum.attrs
    assert notes["unphysical_values"] == 2
    assert notes["name"] == "Plate Glass"
    assert notes["description"] == "a pane: clear, Na\xb7Ca"
    assert notes["subclass"] == ""
    assert notes["source"] == "glass.spectrum.txt"


R20 = " 20.0000"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" 14.0000\t 10.0000\n", "", "Number of X Values is 2, declared '3'"),
        ("14.0000\t", "13.0000\t", "Last X Value is 13, declared '14"),
        ("Values: 3", "Values: many", "Number of X Values: Invalid number 'many'"),
        ("9.5000", "8.0000", "8 micrometres is followed by one not"),
        ("9.5000", "15.000", "15 micrometres is followed by one not"),
        ("Hemispherical Refl", "Bidirectional Refl", "Measurement"),
        ("Hemispherical Reflectance", "Transmittance", "Measurement"),
        ("(percent)", "(fraction)", "Y Units 'Reflectence .fraction"),
        ("(micrometers)", "(nanometers)", "X Units 'Wavelength .nano"),
        (R20, " 2000.0000", "emissivity -19 in 'Plate Glass'"),
        (R20, " -6.0", "emissivity 1.06 in 'Plate Glass'"),
        (R20, " nan", "line 15, column 2: Invalid number 'nan'. Must be finite"),
        (R20, " x", "line 15, column 2: Invalid number 'x'. Must be finite"),
        (R20, " 2 0", "Must be 2 numbers"),
        ("", "", "Invalid Measurement ''"),
    ],
)
def test_ecostress_refuses(tmp_path: Path, old: str, new: str, message: str) -> None:
    """A truncated file, or one without reflectance [%] over micrometres, is refused by name."""
    path = library_file(tmp_path, [8, 9.5, 14], [5, 20, 10])
    text = path.read_text("latin-1")
    assert old in text
    path.write_text(text.replace(old, new) if old else "", encoding="latin-1")
    with pytest.raises(ValueError, match=message) as error:
        readers.ecostress(path)
    assert "glass.spectrum.txt" in str(error.value)


def test_slum(tmp_path: Path) -> None:
    """Each column becomes a spectrum under its sample's code."""
    table = b'"wavelength","A001","R002"\n8.0,0.94,0.41\n14.0,0.95,0.42\n'
    spectra = libraries.slum(written(tmp_path / "slum.csv", table))
    assert list(spectra) == ["A001", "R002"]
    assert_allclose(spectra["R002"]["emissivity"], [0.41, 0.42], rtol=0, atol=0)
    assert_allclose(spectra["R002"]["wavelength"], [8e-6, 14e-6], rtol=0, atol=1e-12)


def test_ucsb(tmp_path: Path) -> None:
    """The falling wavelengths are turned to rise; the name is the third column's."""
    table = b"x1,x2,y_brick\n16,625,0.97\n3.125,3200,0.95\n"
    spectrum = libraries.ucsb(written(tmp_path / "brick.csv", table))
    assert_allclose(spectrum["wavelength"], [3.125e-6, 16e-6], rtol=0, atol=1e-12)
    assert_allclose(spectrum["emissivity"], [0.95, 0.97], rtol=0, atol=0)
    assert spectrum.attrs["name"] == "brick"


A001 = "wavelength,A001\n"


# A table with other columns, gaps, units, or wavenumbers that contradict the wavelengths.
test_tables_are_refused = refused(
    lambda folder, name, text: getattr(libraries, name)(written(folder / "a.csv", text.encode())),
    [
        ("slum", "", "Invalid columns"),
        ("slum", "nm,A001\n8,0.9\n", "Invalid columns"),
        ("slum", "wavelength,A001,A001\n8,0.9,0.9\n", "distinct codes"),
        ("slum", "wavelength,A001\n", "Empty table"),
        ("slum", f"{A001}8,\n", "a.csv, line 2, column 2: Invalid number ''. Must be fin"),
        ("slum", "wavelength,A001\n8\n", "line 2: Invalid row .* Must be 2 numbers"),
        ("slum", "wavelength,A001\n8,0.9\n9", "a.csv, line 3: Truncated line '9'. Must end with"),
        ("slum", 'wavelength,A001\n8,"2\n', "a.csv, line 2: Must be comma-separated values"),
        ("slum", "wavelength,A001\n\n", r"a.csv, line 2: Invalid row \[\]. Must be 2 numbers"),
        ("slum", "wavelength,A001\n8,94\n", "emissivity 94 in 'A001'"),
        ("slum", "wavelength,A001\n8000,0.94\n", "wavelength 8000 in 'A001'"),
        ("ucsb", "x1,x2,z\n10,1000,0.95\n", "Must be x1, x2, y_<name>"),
        ("ucsb", "x1,x2,y_b\n10,1100,0.95\n", "wavenumber 1100.0 1/cm at 10.0 micrometres"),
    ],
    "tmp_path",
    ValueError,
)
