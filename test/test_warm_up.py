"""After warming up no frame waits for the compiler, and what is no camera is said to be none."""

import numpy as np
import pytest

import rs_localizer as rsl
from rs_localizer.estimation import modes, settling, tone_evidence

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_shaking_is_followed_once(direction, monkeypatch):
    """Its kernels are those that an ordinary frame does not need."""
    followed, gains, looked = [], [], []
    follow, gain, look = settling.follow, modes.gain_of_shaking, tone_evidence.spectrum

    def watched(*arguments):
        followed.append(follow(*arguments))
        return followed[-1]

    def weighed(*arguments):
        gains.append(gain(*arguments))
        return gains[-1]

    def listened(*arguments):
        looked.append(look(*arguments))
        return looked[-1]

    monkeypatch.setattr(settling, "follow", watched)
    monkeypatch.setattr(tone_evidence, "spectrum", listened)
    monkeypatch.setattr(modes, "gain_of_shaking", weighed)
    camera = rsl.Camera(640, 480, K, readout_time=0.02, scan_direction=direction)
    rsl.Localizer(camera).warm_up()
    assert any(found is not None for found in followed)
    assert max(gains) > 1.0
    assert looked


def test_a_matrix_is_no_camera_and_a_dictionary_no_prior():
    with pytest.raises(ValueError, match=r"must be an rs_localizer.Camera, got ndarray"):
        rsl.Localizer(K)
    localizer = rsl.Localizer(rsl.Camera(640, 480, K))
    with pytest.raises(ValueError, match=r"must be an rs_localizer.Prior, got dict"):
        localizer.localize(np.zeros((20, 3)), np.zeros((20, 2)), prior={})
