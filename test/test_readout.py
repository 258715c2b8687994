"""The table of readout times, and the conventions."""

import pytest

from rs_localizer.readout import (
    StampAt,
    find_readout,
    from_all_rows,
    from_line_time,
    known_cameras,
    stamp_offset,
)


def test_every_row_of_the_table_makes_sense():
    for known in known_cameras():
        assert 0.0 < known.low <= known.median <= known.high < 0.2
        assert known.number >= (3 if known.source == "gyroflow" else 1)
        assert known.name
        assert known.mode


def test_a_camera_is_found_by_words_and_all_of_its_modes_are_told():
    modes = find_readout("raspberry IMX219")
    assert [known.mode for known in modes] == ["1640x1232", "1920x1080", "3280x2464"]
    (one,) = find_readout("imx219", "1920x1080")
    # The line time of the driver's own numbers.
    assert one.median == pytest.approx(from_line_time(3448 / 182.4e6, 1080), rel=2e-3)


def test_an_unknown_camera_or_mode_is_said_with_what_there_is():
    with pytest.raises(ValueError, match="Sony a7sIII"):
        find_readout("Sonny a7sIII")
    with pytest.raises(ValueError, match="1640x1232"):
        find_readout("imx219", "8000x4000")


def test_conventions():
    assert from_all_rows(0.024, 480) == pytest.approx(from_line_time(0.024 / 480, 480))
    assert stamp_offset(StampAt.START, 0.01) == 0.005
    assert stamp_offset(StampAt.END, 0.01) == -0.005
    assert stamp_offset(StampAt.MIDDLE, 0.01) == 0.0
    assert stamp_offset(StampAt.END, 0.01, middle_row=True, readout_time=0.02) == -0.015
    with pytest.raises(ValueError, match="need the readout time"):
        stamp_offset(StampAt.MIDDLE, 0.01, middle_row=True)
    with pytest.raises(ValueError, match="2 rows"):
        from_line_time(1e-5, 1)
