"""Files of few MB that unpack to gigabytes, or hold very many pieces, and containers that lie."""

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import dask.array as da
import flir_files
import google_crc32c
import h5py
import numcodecs
import numpy as np
import tifffile
import xarray as xr
import zarr
from hostile_files import COUNTS, hdf5_chunk
from zarr.codecs import BytesCodec, GzipCodec, ShardingCodec

from attack.damage import Rng
from attack.files import emptied
from attack.oracle import Attack, Verdict, wrong
from attack.scenes import pick
from dbthermal import readers

_CHUNKED: Final = (1, *COUNTS.shape[1:])


def _zeros(megabytes: int, start: bytes = b"\x78\xda") -> bytes:
    """Deflated zeros, of any size at once, behind the start of a format."""
    stream = zlib.compressobj(9, wbits=-15)
    parts = [stream.compress(bytes(2**20)) + stream.flush(zlib.Z_FULL_FLUSH) for _ in range(2)]
    return start + parts[0] + parts[1] * (megabytes - 1) + stream.flush()


def _megabytes(rng: Rng) -> int:
    return int(2 ** rng.uniform(6, 13))


def _hdf5_chunk(rng: Rng, path: Path) -> None:
    """A chunk that unpacks farther than it should, or whose filter states another size."""
    way = pick(rng, ["deflate", "lzf", "offset"])
    if way == "deflate":
        hdf5_chunk(path, _zeros(_megabytes(rng)), pick(rng, [{1: (6,)}, {2: (2,), 1: (6,)}]))
    if way == "lzf":  # a literal, then repetitions of 264 bytes by 3
        packed = b"\x00\x00" + b"\xe0\xff\x00" * int(2 ** rng.uniform(14, 21))
        hdf5_chunk(path, packed, {32000: (4, 0x0105, int(pick(rng, [4, COUNTS.nbytes])))})
    if way == "offset":
        constant = np.full_like(COUNTS, 18000)
        with h5py.File(path, "w") as file:
            file.create_dataset("frames", data=constant, chunks=COUNTS.shape, scaleoffset=0)
        lie = int(2 ** rng.uniform(12, 31))
        stated, lied = (struct.pack("<III", 2, 0, size) for size in (COUNTS.size, lie))
        path.write_bytes(path.read_bytes().replace(stated, lied))


def _hdf5_time(rng: Rng, path: Path) -> None:
    """Times beside the frames: very many, or very long texts."""
    number, kind = (600, "f8") if rng.random() < 0.5 else (3, f"S{int(2 ** rng.uniform(24, 31))}")
    with h5py.File(path, "w") as file:
        file["frames"] = COUNTS
        length = 10**6 if kind == "f8" else 1
        options: dict[str, Any] = {"chunks": (length,), "compression": "gzip", "maxshape": (None,)}
        times = file.create_dataset("time", (number * length,), kind, **options)
        packed = _zeros(-(-length * times.dtype.itemsize // 2**20))
        for chunk in range(number):
            times.id.write_direct_chunk((chunk * length,), packed)
        times.make_scale("time")
        file["frames"].dims[0].attach_scale(times)


def _hdf5_tree(rng: Rng, path: Path) -> None:
    deep, number = bool(rng.random() < 0.5), int(2 ** rng.uniform(7, 12.5))
    with h5py.File(path, "w") as file:
        file["frames"] = COUNTS
        for name in ["/".join("g" * number)] if deep else map(str, range(number)):
            file.create_group(name)


def _npz(rng: Rng, path: Path) -> None:
    """A header, or an array, that is longer than the file."""
    number = _megabytes(rng) // 4
    start = b"\x93NUMPY\2\0" + struct.pack("<I", number * 2**20)
    if rng.random() < 0.5:
        about = {"descr": "<u2", "fortran_order": False, "shape": (number, 1024, 512)}
        start = b"\x93NUMPY\1\0" + struct.pack("<H", 118) + repr(about).ljust(117).encode() + b"\n"
    # The header stored, then zeros, which are never made here; said to be deflated, and long.
    stream = zlib.compressobj(0, wbits=-15)
    packed = stream.compress(start) + stream.flush(zlib.Z_FULL_FLUSH) + _zeros(number, b"")
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.npy", packed)
    content = bytearray(path.read_bytes())
    listed = content.rindex(b"PK\1\2")
    content[8] = content[listed + 10] = zipfile.ZIP_DEFLATED
    content[22:26] = content[listed + 24 : listed + 28] = b"\xfe\xff\xff\xff"
    path.write_bytes(content)


_STARTS: Final = {"zlib": b"\x78\xda", "gzip": b"\x1f\x8b\x08" + bytes(6) + b"\x03"}


def _zarr_chunk(rng: Rng, path: Path) -> None:
    """A chunk that unpacks farther than it should, or to more streams than one."""
    kind, way = pick(rng, [*_STARTS, "bz2", "lzma", "zstd", "lz4", "blosc"]), rng.random()
    codec = numcodecs.get_codec({"id": kind})
    options: dict[str, Any] = {"chunks": _CHUNKED, "compressors": codec, "zarr_format": 2}
    zarr.create_array(path, data=COUNTS, **options)
    packed = codec.encode(COUNTS[1].tobytes() + bytes(int(2 ** rng.uniform(1, 25))))
    if way < 0.5:
        packed = codec.encode(COUNTS[1].tobytes()) + bytes(codec.encode(bytes(2**20))) * 99
    if kind in _STARTS and way > 0.8:
        packed = _zeros(_megabytes(rng), _STARTS[kind])
    (path / "1.0.0").write_bytes(packed)


def _zarr_shard(rng: Rng, path: Path) -> None:
    """Chunks of one pixel in a shard, or shards in shards."""
    number, chunk = int(4 ** rng.uniform(6, 9)), (1, 1, 1)
    within: Any = BytesCodec()
    counts: Any = (18000 + np.arange(number) % 999).astype("u2").reshape(1, 1, -1)
    index = np.stack([2 * np.arange(number), np.full(number, 2)], 1).astype("<u8").tobytes()
    packed, indices = counts.tobytes(), [index]
    if rng.random() < 0.5:
        counts, chunk, packed = COUNTS, COUNTS.shape, _zeros(_megabytes(rng), _STARTS["gzip"])
        within = ShardingCodec(chunk_shape=chunk, codecs=[BytesCodec(), GzipCodec()])
        indices = [struct.pack("<2Q", 0, len(packed) + more) for more in (0, 20)]
    layers: Any = ShardingCodec(chunk_shape=chunk, codecs=[within])
    options: dict[str, Any] = {"chunks": counts.shape, "serializer": layers, "compressors": None}
    zarr.create_array(path, shape=counts.shape, dtype="u2", **options)
    for index in indices:
        packed += index + struct.pack("<I", google_crc32c.value(index))
    (path / "c/0/0").mkdir(parents=True)
    (path / "c/0/0/0").write_bytes(packed)


_TEXTS: Final = ("unit=", "unit=deg", "DeltaT=", "fps=", '{"shape": [', "<Item role='scale'", " ")


def _tiff(rng: Rng, path: Path) -> None:
    """A description that is long to search, or very many pages."""
    if rng.random() < 0.5:
        text = pick(rng, _TEXTS) * int(rng.integers(1, 9)) + pick(rng, [*"_ 9[<"]) * 10**6
        tifffile.imwrite(path, COUNTS, photometric="minisblack", description=text, metadata=None)
        return
    number, size = int(2 ** rng.uniform(12, 16.5)), 92
    form = ((256, 1), (257, 1), (258, 16), (259, 1), (262, 1), (273, 0), (279, 2))
    pages = [b"II*\0\10\0\0\0"]
    for end in range(8 + size, 8 + size * number + 1, size):
        tags = [struct.pack("<HHII", code, 4, 1, value or end - 2) for code, value in form]
        following = end if end < 8 + size * number else 0
        last = struct.pack("<IH", following, 18000 + end % 999)
        pages.append(struct.pack("<H", len(tags)) + b"".join(tags) + last)
    path.write_bytes(b"".join(pages))


def _png(rng: Rng, path: Path) -> None:
    """Texts and profiles in a picture, in a file of FLIR or alone."""
    image = flir_files.compressed(COUNTS[0], "png")
    kind = pick(rng, [b"zTXta\0\0", b"iCCPa\0\0", b"iTXta\0\1\0\0\0"])
    chunk = kind + _zeros(_megabytes(rng))
    chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    image = image[:33] + chunk + image[33:]
    body = flir_files.geometry(COUNTS[0], 1, "<") + image
    fff = flir_files.frame([(1, 2, body)], "<", sums=False)
    path.write_bytes(image if rng.random() < 0.5 else fff)


def _netcdf(rng: Rng, path: Path) -> None:
    """A variable of very many dims, of one number each."""
    dims = int(2 ** rng.uniform(6, 17.5))
    words = [struct.pack(">5I", 0, 10, 1, 1, 0x74000000), struct.pack(">I", 1) + bytes(8)]
    words += [struct.pack(f">{dims + 5}I", 11, 1, 1, 0x61000000, dims, *[0] * dims) + bytes(8)]
    start = 4 + sum(map(len, words)) + 12
    path.write_bytes(b"CDF\1" + b"".join(words) + struct.pack(">4I", 8, 2, start, 0))


BOMBS: Final[dict[str, Callable[[Rng, Path], None]]] = {
    "chunk.h5": _hdf5_chunk,
    "time.h5": _hdf5_time,
    "tree.h5": _hdf5_tree,
    "header.npz": _npz,
    "chunk.zarr": _zarr_chunk,
    "shard.zarr": _zarr_shard,
    "stack.tif": _tiff,
    "picture.png": _png,
    "dims.nc": _netcdf,
}
"""File -> what makes one of at most 10 MB that takes much memory or time if nothing is checked."""


def _read(source: Any) -> xr.Dataset:
    """Counts of a file or array at 10 Hz, by the reader of its form."""
    form = source.suffix if isinstance(source, Path) else ""
    if form == ".png" and source.read_bytes()[:3] == b"FFF":
        return readers.flir(source, clock=10.0)
    reader = readers.tiff if form in {".tif", ".png"} else readers.array
    return reader(source, unit="count", clock=10.0)


def _blocks(change: Callable[[Any], Any]) -> Callable[[Rng, Path], Any]:
    """Array of dask that says to be of uint16, and of which a block is another one."""
    blocks = da.from_array(COUNTS, chunks=_CHUNKED)
    return lambda *_: blocks.map_blocks(change, dtype="u2", meta=np.empty((0, 0, 0), "u2"))


def _short(rng: Rng, path: Path) -> Path:
    """HDF5 whose chunk has fewer numbers than it should."""
    part = COUNTS.tobytes()[: int(rng.integers(2, COUNTS.nbytes))]
    packed = pick(rng, [(part, {}), (part, {2: (2,)}), (zlib.compress(part), {1: (6,)})])
    return hdf5_chunk(path.with_suffix(".h5"), *packed)


def _stored(options: dict[str, Any], times: Any = None, **attrs: Any) -> Callable[..., Path]:
    """HDF5 by some options, with times in numbers or text, and attributes of its counts."""

    def make(_: Rng, path: Path) -> Path:
        with h5py.File(path := path.with_suffix(".h5"), "w") as file:
            file.create_dataset("frames", data=COUNTS, **options).attrs.update(attrs)
            if times is not None:
                file["time"] = [*times]
        return path

    return make


_NOON: Final = "2026-10-25T0{}:59:59.{}{}"  # about the end of summer time
FALSE: Final[dict[str, Callable[[Rng, Path], Any]]] = {
    "blocks of floats": _blocks(lambda block: block + 0.4),
    "negative blocks": _blocks(lambda block: block.astype(int) - 40000),
    "blocks in another order of bytes": _blocks(lambda block: block.astype(">u2")),
    "blocks of another size": _blocks(lambda block: block[:, 1:]),
    "masked blocks": _blocks(lambda block: np.ma.masked_greater(block, 18100)),
    "a short chunk": _short,
    "a fill value that is there": _stored({}, _FillValue=COUNTS[1, 2, 3]),
    "a scale of NaN": _stored({}, Scale_Factor=np.nan),
    "times that go back": _stored({}, (0.0, 0.2, 0.1)),
    "times that are NaN": _stored({}, (0.0, np.nan, 0.2)),
    "times in two zones": _stored({}, [_NOON.format(2, n, f"+0{2 - n % 2}:00") for n in range(3)]),
}
"""Containers that say what is not so: they are refused."""
TRUE: Final[dict[str, Callable[[Rng, Path], Any]]] = {
    "turned in memory": lambda *_: COUNTS[::-1, ::-1, ::-1].copy()[::-1, ::-1, ::-1],
    "read only": lambda *_: np.frombuffer(COUNTS.tobytes(), "u2").reshape(COUNTS.shape),
    "masked nowhere": lambda *_: np.ma.masked_equal(COUNTS, 1),
    "blocks as declared": _blocks(lambda block: block),
    "a chunk not packed": _stored({"chunks": _CHUNKED, "compression": "lzf"}),
    "a negative fill value": _stored({}, _FillValue=-1, missing_value=np.nan, units=" Counts "),
    "attributes of no meaning": _stored({}, comment=np.nan, empty="", NAME=b"\xff", valid_min=-1),
    "times in two zones of one moment": _stored(
        {}, [_NOON.format(2 - n, n, f"+0{2 - n}:00") for n in range(3)]
    ),
}
"""Containers that are right, and unusual: they are read."""


def container(rng: Rng, name: str) -> Attack:
    """A container of a name: its counts are as stored, or it is refused by name."""
    path = emptied() / name
    if name in BOMBS:
        BOMBS[name](rng, path)
        source: Any = path
    else:
        path = path.with_name("lie")
        source = {**TRUE, **FALSE}[name](rng, path)

    def judge(opened: xr.Dataset) -> Verdict:
        alike = opened["counts"].shape == COUNTS.shape
        is_stored = name not in FALSE and alike and np.array_equal(opened["counts"], COUNTS)
        # Of a bomb, as of very many pages, counts of another size may be right.
        return wrong("other counts", where=not is_stored and (alike or name not in BOMBS))

    names = f"array|frames|{path.name}"
    return Attack(name, lambda: _read(source), judge, (names,), name in TRUE)


def bombs(rng: Rng) -> Attack:
    """A file of at most 10 MB that takes much memory or time where sizes are not checked."""
    return container(rng, pick(rng, [*BOMBS]))


def lies(rng: Rng) -> Attack:
    """A container that is not as it says, or an unusual one that is."""
    return container(rng, pick(rng, [*FALSE, *TRUE]))
