"""Numbers and layouts of the calls of Video4Linux2, made as the kernel's header makes them."""

import ctypes

import pytest

from dbthermal.instruments import v4l2


class Buffer(ctypes.Structure):
    """``struct v4l2_buffer`` as in ``linux/videodev2.h``, laid out by the compiler's rules."""

    _fields_ = (
        *((name, ctypes.c_uint32) for name in ("index", "type", "bytesused", "flags", "field")),
        ("seconds", ctypes.c_int64),  # struct timeval
        ("microseconds", ctypes.c_int64),
        ("timecode", ctypes.c_uint32 * 4),
        *((name, ctypes.c_uint32) for name in ("sequence", "memory")),
        ("offset", ctypes.c_uint64),  # union with a pointer
        *((name, ctypes.c_uint32) for name in ("length", "reserved2", "request_fd")),
    )


def test_layouts_have_the_kernels_sizes() -> None:
    """The structures are as large as on 64-bit Linux."""
    assert (v4l2.BUFFER.size, v4l2.FORMAT.size) == (88, 208)
    assert (v4l2.CAPABILITY.size, v4l2.PARAMETERS.size) == (104, 204)


def test_buffer_has_the_kernels_layout() -> None:
    """Each number of a buffer is where a C compiler puts it, the 64-bit time stamp too."""
    left_out = {"timecode", "reserved2", "request_fd"}
    names = [field[0] for field in Buffer._fields_ if field[0] not in left_out]
    buffer = Buffer.from_buffer_copy(v4l2.BUFFER.pack(*range(1, 12)))
    assert ctypes.sizeof(Buffer) == v4l2.BUFFER.size
    assert [getattr(buffer, name) for name in names] == list(range(1, 12))


@pytest.mark.parametrize(
    ("name", "direction", "number", "size"),
    [
        ("QUERYCAP", 2, 0, 104),
        ("ENUM_FMT", 3, 2, 64),
        ("S_FMT", 3, 5, 208),
        ("REQBUFS", 3, 8, 20),
        ("QUERYBUF", 3, 9, 88),
        ("QBUF", 3, 15, 88),
        ("DQBUF", 3, 17, 88),
        ("STREAMON", 1, 18, 4),
        ("STREAMOFF", 1, 19, 4),
        ("S_PARM", 3, 22, 204),
    ],
)
def test_calls_have_the_kernels_numbers(name: str, direction: int, number: int, size: int) -> None:
    """A call's number is made of direction (1 write, 2 read), size, 'V' and its own number."""
    expected = direction << 30 | size << 16 | ord("V") << 8 | number
    assert getattr(v4l2, name) == expected
