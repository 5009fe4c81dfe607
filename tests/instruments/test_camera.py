"""The interface of a camera: state of the shutter, and kinds of cameras by name."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.correction._shutter import FEWEST_COPIES
from dbthermal.instruments.camera import (
    FfcStatus,
    Shutter,
    camera_kind,
    next_shutter,
)

IMMINENT, BUSY, DONE = FfcStatus.IMMINENT, FfcStatus.IN_PROGRESS, FfcStatus.COMPLETE


def closed(
    copies: str,
    last: Sequence[int | None] | None = None,
    status: Sequence[FfcStatus | None] | None = None,
) -> str:
    """Frames that count as closed, x, of frames that repeat the image before, also x."""
    state, found = Shutter(), ""
    nothing = [None] * len(copies)
    for mark, frame, read in zip(copies, last or nothing, status or nothing, strict=True):
        state = next_shutter(state, repeated=mark == "x", last_ffc_frame=frame, ffc_status=read)
        found += "x" if state.closed else "."
    return found


def test_a_renewal_at_the_start_of_a_correction_closes_all_copies() -> None:
    """The camera counts the correction from its first frozen frame."""
    assert closed("...xxxx..", [0, 0, 0, 3, 3, 3, 3, 3, 3]) == "...xxxx.."


def test_a_renewal_at_the_end_of_a_correction_marks_the_frame_after_it() -> None:
    """The run of copies touches the marked frame, so that `find_shutter` joins them."""
    assert closed("...xxxx..", [0, 0, 0, 0, 0, 0, 0, 7, 7]) == ".......x."


def test_a_renewal_whose_frozen_frames_were_lost_is_marked() -> None:
    """A correction marks one frame without a repeated image; damaged telemetry is not used."""
    assert closed(".....", [0, 0, 3, 3, 3]) == "..x.."
    assert closed(".....", [0, 0, None, 3, 3]) == "...x."


def test_repeated_images_of_a_camera_with_telemetry_are_no_shutter() -> None:
    """With telemetry, repeated images without a correction are not marked as a shutter."""
    assert closed("..x.xxxxx.", [5] * 10) == ".........."


@pytest.mark.parametrize("status", [IMMINENT, BUSY])
def test_the_serial_line_closes_a_frozen_image(status: FfcStatus) -> None:
    """From the first copy after the reading to the last copy, however old the reading is."""
    read = [DONE, DONE, DONE, status, status, DONE, DONE, DONE]
    assert closed("..xxxx..", status=read) == "...xxx.."
    assert closed("........", status=[status] * 8) == "........"


def test_without_telemetry_a_run_of_copies_is_the_shutter() -> None:
    """Without telemetry three copies or more mark a closed shutter, fewer are lost frames."""
    expected = "....xx."
    assert closed("..xxxx.") == expected
    assert closed("..xxxx.", status=[DONE] * 7) == expected
    assert closed("..xx.x.") == "......."
    assert FEWEST_COPIES == 3


@given(
    st.lists(
        st.tuples(
            st.booleans(),
            st.none() | st.integers(0, 3),
            st.none() | st.sampled_from(FfcStatus),
        )
    )
)
def test_a_changing_image_is_closed_by_a_renewal_alone(
    frames: list[tuple[bool, int | None, FfcStatus | None]],
) -> None:
    """A frame with a new image is marked only if the number of the last correction changed."""
    state = Shutter()
    for repeated, last, status in frames:
        after = next_shutter(state, repeated=repeated, last_ffc_frame=last, ffc_status=status)
        renewed = None not in {last, state.last_ffc_frame} and last != state.last_ffc_frame
        assert after.closed is renewed or repeated
        assert after.copies == (state.copies + 1 if repeated else 0)
        state = after


def test_an_unknown_kind_is_named() -> None:
    """An unknown kind of camera raises an error that lists the known ones."""
    with pytest.raises(ValueError, match=r"Unknown kind of camera 'lepton'\. Must be one of \["):
        camera_kind("lepton")
