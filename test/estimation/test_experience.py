import numpy as np

from rs_localizer.core.types import Estimate
from rs_localizer.estimation.experience import Experience


def seen(shake, field):
    """An estimate of a frame that says so much of one size of either."""
    return Estimate(
        rotation=np.eye(3), translation=np.zeros(3), angular_velocity=np.zeros(3),
        linear_velocity=np.zeros(3), inliers=np.ones(12, bool), residuals=np.zeros(12),
        joint_covariance=np.eye(18), global_shutter_inliers=12, iterations=0,
        of_shake_sizes=np.array([0.0, shake]), of_field_sizes=np.array([0.0, field]),
    )  # fmt: skip


def test_what_frames_say_adds_up_and_fades():
    experience = Experience.of(seen(1.0, -2.0))
    np.testing.assert_array_equal(experience.of_field_sizes, [0.0, -2.0])
    experience = experience.and_of(seen(2.0, 4.0))
    np.testing.assert_allclose(experience.of_shake_sizes, [0.0, 0.95 * 1.0 + 0.3 * 2.0])
    np.testing.assert_allclose(experience.of_field_sizes, [0.0, 0.95 * -2.0 + 0.3 * 4.0])
    # A constant message settles at six times itself: 0.3 / (1 - 0.95).
    for _ in range(400):
        experience = experience.and_of(seen(2.0, 4.0))
    np.testing.assert_allclose(experience.of_shake_sizes, [0.0, 12.0], atol=1e-6)


def test_a_prior_says_it_and_nothing_of_the_motion():
    prior = Experience.of(seen(3.0, 4.0)).prior
    assert prior.motion is None
    assert (prior.of_shake_sizes[1], prior.of_field_sizes[1]) == (3.0, 4.0)
