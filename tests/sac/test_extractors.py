"""What the networks read: every part of the delayed observation, in order, and nothing else."""

import pytest
import torch as th
from gymnasium import spaces

from sb3_said.sac.extractors import KeyExtractor, StateAugmentedExtractor


def make_space(max_delay):
    return spaces.Dict(
        observation=spaces.Box(-1, 1, (3,)),
        action_history=spaces.Box(-1, 1, (max_delay, 2)),
        delay=spaces.Box(0, float(max_delay), (1,)),
    )


@pytest.mark.parametrize("max_delay", [0, 1, 4])
def test_state_augmented(max_delay):
    extractor = StateAugmentedExtractor(make_space(max_delay))
    observations = {
        "delay": th.full((5, 1), float(max_delay)),
        "action_history": th.rand(5, max_delay, 2),
        "observation": th.rand(5, 3),
    }
    features = extractor(observations)
    assert features.shape == (5, extractor.features_dim) == (5, 3 + 2 * max_delay + 1)
    assert th.equal(features[:, :3], observations["observation"])
    for k in range(max_delay):  # oldest action first
        assert th.equal(features[:, 3 + 2 * k : 5 + 2 * k], observations["action_history"][:, k])
    assert th.equal(features[:, -1], th.full((5,), float(max_delay > 0)))  # the largest age reads 1


def test_age_is_a_fraction_of_the_largest():
    extractor = StateAugmentedExtractor(make_space(8))
    ages = th.tensor([[0.0], [2.0], [8.0]])
    features = extractor({"observation": th.zeros(3, 3), "action_history": th.zeros(3, 8, 2), "delay": ages})
    assert features[:, -1].tolist() == [0.0, 0.25, 1.0]


def test_actions_older_than_the_observation_are_not_shown():
    extractor = StateAugmentedExtractor(make_space(4))
    history = th.rand(5, 4, 2) + 0.1
    ages = th.arange(5.0)[:, None]
    features = extractor({"observation": th.zeros(5, 3), "action_history": history, "delay": ages})
    shown = features[:, 3:-1].unflatten(1, (4, 2))
    for age in range(5):
        assert th.equal(shown[age, 4 - age :], history[age, 4 - age :])
        assert not shown[age, : 4 - age].any()


def test_key():
    extractor = KeyExtractor(make_space(2), "observation")
    observation = th.rand(5, 3)
    # The other keys are not even looked at: a deployed actor may have no true state
    assert th.equal(extractor({"observation": observation}), observation)
    assert extractor.features_dim == 3


def test_unknown_key():
    with pytest.raises(KeyError, match="undelayed_observation"):
        KeyExtractor(make_space(2), "undelayed_observation")
