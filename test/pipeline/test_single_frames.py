"""What a camera without a readout time remembers from frame to frame."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.core.scales import SCALES, Scales
from rs_localizer.core.types import Failure
from rs_localizer.pipeline.frames import ANY_CALIBRATION, Method
from rs_localizer.pipeline.single_frames import SingleFrames

SAID = Scales.nothing()._replace(means=np.full(SCALES, -6.0), precisions=np.ones(SCALES))


def test_the_next_frame_knows_what_the_last_one_with_a_pose_said_until_reset():
    priors: list[Any] = []
    said = {"scales": SAID, "lens": None, "of_lens": None}
    results: list[Any] = [SimpleNamespace(**said)] * 3
    results.insert(1, Failure(Reason.NO_HYPOTHESIS, ""))

    def localize(points: Any, pixels: Any, scores: Any, prior: Any) -> Any:
        priors.append(prior)
        return results[len(priors) - 1]

    localizer: Any = SimpleNamespace(find=localize, accepted=lambda found: found,
                                     config=NodeConfig())  # fmt: skip
    frames = SingleFrames(localizer, remembers=True)
    for _ in range(3):
        frames.localize(0, [], [])
    assert priors[0] is None
    for prior in priors[1:]:
        assert prior.motion is None
        np.testing.assert_allclose(prior.scales.means, -6.0)
        assert prior.scales.precisions.min() >= 1.0
    frames.reset()
    frames.localize(0, [], [])
    assert priors[3] is None


def test_it_takes_the_place_of_tracking():
    def remembers(**settings: Any) -> tuple[bool, bool]:
        method = Method.of(ANY_CALIBRATION, NodeConfig(**settings))
        frames = method.frames
        return method.tracker is not None, isinstance(frames, SingleFrames) and frames.remembers

    assert remembers() == (False, True)
    assert remembers(readout_time=0.02) == (True, False)
    assert remembers(tracking=False) == (False, False)
    assert remembers(solver="p3p") == (False, False)
