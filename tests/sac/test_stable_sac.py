"""StableSAC: scales of rewards and states against NumPy and SB3, values in the rewards' own units, a slower actor."""

import copy
import pickle
import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small_agent import make as make_agent
from small_agent import observe
from small_task import Drift, delayed, pendulum
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn import functional as F

from sb3_said import SAID, DelayedSAC, StableSAC
from sb3_said.delays.space import UNDELAYED
from sb3_said.files.archive import SavedFileError
from sb3_said.planner.plain import ZScored
from sb3_said.sac.scaling import ReturnScale, StateNormalizer

AS_SADR = {
    "scale_rewards": False,
    "normalise_states": False,
    "policy_delay": 1,
    "actor_averaging": 0.0,
    "ent_coef": "auto",
    "target_entropy": "auto",
}
# Learns values fast, of a reward that no action changes: so the actor may stay as it is
QUICK = {"gamma": 0.7, "tau": 0.15, "ent_coef": 0.0, "learning_rate": 2e-2, "batch_size": 64, "policy_delay": 1000}


make = partial(make_agent, cls=StableSAC)


def with_rewards(reward):
    """Return the small task with another reward a step."""
    return gym.wrappers.TransformReward(Drift(), lambda _: reward)


# ----------------------------------------------------------------------------------------------------------- scales


@given(st.lists(arrays(np.float64, 3, elements=st.floats(-1e3, 1e3)), min_size=1, max_size=8))
def test_the_scale_of_returns(batches):
    scale = ReturnScale()
    for returns in batches:
        scale.update(returns)
    everything = np.concatenate(batches)
    np.testing.assert_allclose(
        [scale.mean, scale.variance, scale.count], [everything.mean(), everything.var(), everything.size], atol=1e-9
    )
    size = max(everything.std(), np.abs(everything).max() / 5)
    np.testing.assert_allclose(scale.value, size if np.float32(size) > 0 else 1.0, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("unit", [2.0**-27, 2.0**27])
def test_the_unit_of_rewards_does_not_matter(unit):
    def learned(unit):
        return make(env=with_rewards(unit), learning_starts=20).learn(60)

    found, expected = learned(unit), learned(1.0)
    assert float(found.policy.return_scale.value) == unit * float(expected.policy.return_scale.value)
    weights = zip(found.policy.parameters(), expected.policy.parameters(), strict=True)
    assert all(th.equal(weight, of_one) for weight, of_one in weights)


def test_before_the_first_return_nothing_is_scaled():
    assert ReturnScale().value == 1.0
    states = th.randn(4, 3)
    assert th.equal(StateNormalizer(3)(states), states)


def test_states_are_scored():
    normalizer, states = StateNormalizer(3), th.randn(500, 3) * th.tensor([1.0, 50.0, 0.0]) + th.tensor([0.0, 7.0, 2.0])
    normalizer.fit(states, 500)
    scores = normalizer(states)
    np.testing.assert_allclose(scores.mean(0), 0.0, atol=1e-4)
    np.testing.assert_allclose(scores.std(0, correction=0), [1, 1, 0], atol=1e-3)
    assert normalizer(th.full((1, 3), 1e6)).max() == 10  # an entry that never moved, and then does


@pytest.mark.parametrize("unit", [1e-30, 1e-7, 1e7, 1e30])
@pytest.mark.parametrize("scale", [StateNormalizer, ZScored])
def test_the_unit_of_a_state_does_not_matter(scale, unit):
    def scores(states):
        made = scale(2)
        made.fit(states, 0) if scale is StateNormalizer else made.scale_to(states)
        return made(states) if scale is StateNormalizer else made._z(states)

    states = th.randn(500, 2) + 3
    th.testing.assert_close(scores(unit * states), scores(states), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("constant", [1000.1, 12345.678, -3e-3])
@pytest.mark.parametrize("n", [137, 1000, 9999])
def test_an_entry_that_never_moves_is_scored_0(constant, n):
    normalizer, states = StateNormalizer(1), th.full((n, 1), constant)
    normalizer.fit(states, n)
    assert normalizer(states).abs().max() < 0.01


@pytest.mark.parametrize("cls", [StableSAC, SAID])
def test_no_float64_is_asked_of_a_device(cls):
    """Apple's GPUs have none; the statistics are on the CPU, where to read one waits for nothing."""
    policy, moved = make(cls=cls).learn(25).policy, []
    before = {name: x.clone() for name, x in policy.state_dict().items()}
    policy._apply(lambda x: (moved.append(x.dtype), x.clone())[1])
    assert th.float32 in moved and th.float64 not in moved
    assert list(policy.state_dict()) == list(before)
    assert all(th.equal(x, before[name]) for name, x in policy.state_dict().items())
    scale = copy.deepcopy(policy).to("meta").return_scale
    assert scale.value.is_meta and scale.mean.device.type == "cpu"


def test_a_scale_is_read_from_a_file():
    scale, other = ReturnScale(), ReturnScale()
    scale.update(np.array([3.0, 40.0]))
    assert "value" not in scale.state_dict() and scale.value != 1
    other.load_state_dict(scale.state_dict())
    assert th.equal(other.value, scale.value)


# --------------------------------------------------------------------------------------------------------- learning


def test_the_running_return_is_that_of_each_episode():
    model = make(make_vec_env(Drift, n_envs=2), gamma=0.5, learning_starts=100).learn(72)  # three episodes of 12 each
    returns = np.cumsum(0.5 ** np.arange(12))  # of a reward of 1 a step
    scale = model.policy.return_scale
    np.testing.assert_allclose([scale.mean, scale.count, scale.largest], [returns.mean(), 72, 2], rtol=1e-3)


@pytest.mark.parametrize("task", ["plain", "delayed"])
@pytest.mark.parametrize("reward", [1.0, 300.0])
def test_values_are_in_the_units_of_rewards(task, reward):
    """A reward that goes on for ever is worth r / (1 - gamma), whatever its size; the critics hold it scaled."""
    env = with_rewards(reward)
    if task == "delayed":
        env = delayed(2)
        env.env = with_rewards(reward)
    model = make(env, cls=SAID, **QUICK).learn(190)
    batch = model.replay_buffer.sample(200)
    states = batch.observations[UNDELAYED] if task == "delayed" else batch.observations
    with th.no_grad():
        held = th.cat(model.critic(batch.observations, batch.actions), dim=1)
        values = model.policy.q_value(states, batch.actions)
    np.testing.assert_allclose(values, reward / (1 - 0.7), rtol=0.1)
    assert held.max() < 10  # the largest return of an episode is 5
    assert model._stored_values(states, batch.actions).shape == values.shape


def test_what_actor_and_critics_read_of_states():
    model = make(delayed(3)).learn(60)
    normalizer, batch = model.policy.state_normalizer, model.replay_buffer.sample(8).observations
    actor, critic = model.actor.features_extractor(batch), model.critic.features_extractor(batch)
    assert normalizer.fitted_at > 50
    th.testing.assert_close(actor[:, :2], (batch["observation"] - normalizer.mean) / normalizer.deviation)
    th.testing.assert_close(critic, (batch[UNDELAYED] - normalizer.mean) / normalizer.deviation)
    seen = model.replay_buffer.observations[: model.replay_buffer.size()].reshape(-1, 2)
    np.testing.assert_allclose(normalizer.mean, seen.mean(0), atol=0.5 * seen.std(0).min())  # of as many, drawn
    th.testing.assert_close(actor[:, -1:], batch["delay"] / 3)  # ages and actions as they are


def test_states_are_looked_at_where_critics_see_them():
    model = make(delayed(3), learning_starts=1000).learn(60)
    sample = model.replay_buffer.sample

    def apart(*args, **kwargs):
        batch = sample(*args, **kwargs)
        batch.observations[UNDELAYED] = batch.observations["observation"] + 5.0
        apart.mean = batch.observations[UNDELAYED].mean(0)
        return batch

    model.replay_buffer.sample = apart
    model._look_at_states()
    th.testing.assert_close(model.policy.state_normalizer.mean, apart.mean)


@pytest.mark.parametrize("anew", [True, False])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_an_agent_without_its_replay_keeps_its_scales_until_it_has_seen_as_much_again(anew, n_envs, tmp_path):
    """Else its networks would read the states of random actions, or of few, in units that they have not learned in."""
    model = make(make_vec_env(lambda: delayed(3), n_envs), train_freq=5).learn(90)
    model.save(tmp_path / "agent.zip")
    loaded = StableSAC.load(tmp_path / "agent.zip", env=make_vec_env(lambda: delayed(3), n_envs), device="cpu")
    normalizer = loaded.policy.state_normalizer
    fitted_at, mean = float(normalizer.fitted_at), normalizer.mean.clone()
    assert fitted_at > 60
    loaded.learn(60, reset_num_timesteps=anew)
    assert loaded._n_updates > model._n_updates and th.equal(normalizer.mean, mean)
    loaded.learn(60, reset_num_timesteps=False)
    assert not th.equal(normalizer.mean, mean) and normalizer.deviation.min() > 0.05
    assert normalizer.fitted_at <= loaded.num_timesteps


def test_a_running_return_goes_on_where_its_episode_does():
    whole = make(delayed(1, length=40), gamma=0.9, learning_starts=1000).learn(40)
    chunks = make(delayed(1, length=40), gamma=0.9, learning_starts=1000)
    for _ in range(10):
        chunks.learn(4, reset_num_timesteps=False)
    assert chunks.policy.return_scale.value == whole.policy.return_scale.value > 1


def test_a_new_training_s_returns_begin_with_its_episodes():
    model = make(Drift(), gamma=0.5, learning_starts=100).learn(3)
    model.learn(2)  # the episode before was cut off
    assert model.policy.return_scale.largest == 1 + 0.5 + 0.25
    assert model._running_returns == 1 + 0.5


def test_a_step_that_a_callback_has_played_over_does_not_count_in_the_scale_of_rewards():
    class Play(BaseCallback):
        def _on_step(self):
            if self.n_calls == 6:  # an episode's first step, behind one that has ended
                with self.model.borrowed_env() as env:
                    env.reset()
            return True

    model = make(Drift(length=5), gamma=0.5, learning_starts=100).learn(20, callback=Play())
    scale = model.policy.return_scale
    assert round(float(scale.count)) == model.replay_buffer.size() == 19  # its observation is gone
    assert scale.largest == pytest.approx(sum(0.5**k for k in range(5)))


def test_all_rates_follow_the_schedule():
    model = make(learning_rate=lambda remaining: 0.01 * remaining).learn(25)
    optimizers = model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer
    assert [optimizer.param_groups[0]["lr"] for optimizer in optimizers] == pytest.approx([0.0] * 3, abs=1e-9)


def test_steps_that_are_counted_anew_have_their_states_looked_at():
    model = make(delayed(3), train_freq=5).learn(200)
    normalizer = model.policy.state_normalizer
    assert normalizer.fitted_at > 100
    normalizer.mean.fill_(1e6)  # as of another task
    model.learn(40, reset_num_timesteps=False)
    assert normalizer.mean.abs().max() < 100
    normalizer.mean.fill_(1e6)
    model.learn(40)
    assert normalizer.mean.abs().max() < 100 and normalizer.fitted_at <= 40


def test_one_update_is_that_of_the_formulas():
    model = make(learning_starts=1000).learn(50)
    model.policy.state_normalizer.fit(th.randn(100, 2) * 3, 10**9)  # not looked at again
    model.policy.return_scale.update(np.full(50, 40.0))
    batch, scale = model.replay_buffer.sample(16), model.policy.return_scale.value
    batch = batch._replace(dones=(th.arange(16) % 2).float()[:, None])  # what follows an end is worth nothing
    model.replay_buffer.sample = lambda *_, **__: batch
    critic, actor = model.critic, model.actor
    before = [parameter.clone() for parameter in actor.parameters()]

    th.manual_seed(1)
    with th.no_grad():
        action, log_prob = actor.action_log_prob(batch.next_observations)
        value = th.min(*model.critic_target(batch.next_observations, action)).squeeze(1) - 0.01 * log_prob
        target = batch.rewards.squeeze(1) / scale + model.gamma * (1 - batch.dones.squeeze(1)) * value
    first, second = critic(batch.observations, batch.actions)
    loss = 0.5 * F.mse_loss(first.squeeze(1), target) + 0.5 * F.mse_loss(second.squeeze(1), target)
    expected = th.autograd.grad(loss, list(critic.parameters()))

    th.manual_seed(1)
    model.train(1, 16)
    for parameter, gradient in zip(critic.parameters(), expected, strict=True):
        th.testing.assert_close(parameter.grad, gradient)
    assert all(map(th.equal, before, actor.parameters()))  # its turn is the next

    assert model.log_ent_coef.exp().item() == pytest.approx(0.01)
    critic.optimizer.step = lambda: None  # what the actor is to see of the critics is known
    th.manual_seed(2)
    actor.action_log_prob(batch.next_observations)  # of the target, as before
    actions, log_prob = actor.action_log_prob(batch.observations)
    loss = (0.01 * log_prob - th.min(*critic(batch.observations, actions)).squeeze(1)).mean()
    expected = th.autograd.grad(loss, list(actor.parameters()))
    th.manual_seed(2)
    model.train(1, 16)
    for parameter, gradient in zip(actor.parameters(), expected, strict=True):
        th.testing.assert_close(parameter.grad, gradient)
    assert not any(map(th.equal, before, actor.parameters()))
    gradient = -(log_prob.detach() + model.target_entropy).mean()
    th.testing.assert_close(model.log_ent_coef.grad, gradient.reshape(1))
    assert model.log_ent_coef.exp().item() != pytest.approx(0.01, rel=1e-6)


def test_targets_follow_the_critics_each_interval_and_their_batch_norm_at_once():
    kwargs = {"policy_kwargs": {"net_arch": [16], "features_extractor_class": Normalized}, "learning_starts": 1000}
    model = make(Drift(), target_update_interval=3, tau=0.1, **kwargs).learn(40)
    running = "features_extractor.extractor.norm.running_mean"
    before = [parameter.clone() for parameter in model.critic_target.parameters()]
    for k in range(1, 4):
        model.train(1, 16)
        own, target = model.critic.state_dict()[running], model.critic_target.state_dict()[running]
        assert own.abs().min() > 0  # it has learned
        assert th.equal(own, target) == (k == 3)
        for old, new, learned in zip(before, model.critic_target.parameters(), model.critic.parameters(), strict=True):
            th.testing.assert_close(new, old + 0.1 * (learned - old) if k == 3 else old)


def test_state_dependent_exploration_is_drawn_anew_for_each_batch_and_answer():
    model, drawn = make(delayed(2), use_sde=True, learning_starts=1000).learn(30), []
    reset = model.actor.reset_noise
    model.actor.reset_noise = lambda *args, **kwargs: drawn.append(0) or reset(*args, **kwargs)
    model.train(3, 16)
    assert len(drawn) == 3
    average = model.policy.averaged_actor.action_dist
    for draw in (model.policy.reset_noise, lambda: model.train(2, 16)):  # whose average has learned another spread
        before = average.exploration_mat.clone()
        draw()
        assert not th.equal(average.exploration_mat, before)


class Frozen(FlattenExtractor):
    """Features that a user has learned elsewhere."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.layer = th.nn.Linear(self.features_dim, self.features_dim).requires_grad_(False)

    def forward(self, observations):
        return self.layer(super().forward(observations))


def test_what_a_user_has_frozen_stays():
    model = make(Drift(), policy_kwargs={"net_arch": [16], "features_extractor_class": Frozen})
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    after = model.learn(30).policy.state_dict()
    frozen = [name for name in before if ".layer." in name]
    assert len(frozen) == 2 * 4  # of actor, critic, target and average; the last two are mixed of equal numbers
    for name in frozen:
        th.testing.assert_close(after[name], before[name], rtol=1e-5, atol=1e-6)
    assert not th.equal(before["actor.mu.weight"], after["actor.mu.weight"])


@pytest.mark.parametrize("cls", [StableSAC, SAID])
def test_a_copy_of_an_agent_that_has_learned_answers_as_it_does(cls):
    model, (obs, _) = make(delayed(2), cls=cls).learn(30), delayed(2).reset(seed=0)
    for copied in (copy.deepcopy(model), copy.deepcopy(model.policy)):
        np.testing.assert_array_equal(
            copied.predict(obs, deterministic=True)[0], model.predict(obs, None, None, True)[0]
        )


def test_the_actor_is_slower():
    model, changes, before = make(policy_delay=3, learning_starts=1000).learn(40), [], None
    for _ in range(12):
        model.train(1, 16)
        now = model.actor.mu.weight.detach().clone()
        changes.append(before is not None and not th.equal(now, before))
        before = now
    assert changes == [False, False, True] * 4


class Normalized(FlattenExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.norm = th.nn.BatchNorm1d(self.features_dim)

    def forward(self, observations):
        return self.norm(super().forward(observations))


@pytest.mark.parametrize("decay", [0.5, 0.999])
def test_the_average_of_the_actor(decay):
    """The first updates weigh as n^3, but none of later ones is forgotten sooner than the decay says."""
    kwargs = {"policy_kwargs": {"net_arch": [16], "features_extractor_class": Normalized}, "policy_delay": 1}
    model = make(Drift(), actor_averaging=decay, learning_starts=1000, **kwargs).learn(40)
    average, expected = model.policy.averaged_actor, None
    th.testing.assert_close(average.state_dict(), model.actor.state_dict())  # before there is anything to average
    for n in range(1, 13):
        model.train(1, 16)
        weights = model.actor.mu.weight.detach().clone()
        keep = min(decay, max(0, 1 - 4 / n))
        expected = weights if expected is None else keep * expected + (1 - keep) * weights
        th.testing.assert_close(average.mu.weight, expected)
    running = "features_extractor.extractor.norm.running_mean"
    assert th.equal(average.state_dict()[running], model.actor.state_dict()[running]) and not average.training
    assert model.policy.state_normalizer.deviation.min() > 0.05  # shared, and left alone


def test_the_average_answers_and_the_actor_collects(tmp_path):
    model = make(delayed(2)).learn(30)
    obs, _ = delayed(2).reset(seed=0)
    with th.no_grad():
        model.policy.averaged_actor.mu.bias.fill_(5.0)
        model.actor.mu.bias.fill_(-5.0)
    assert model.predict(obs, deterministic=True)[0] == pytest.approx(2.0, abs=0.1)
    with model.policy.without_average():
        assert model.predict(obs, deterministic=True)[0] == pytest.approx(-2.0, abs=0.1)
    model.learn(10, reset_num_timesteps=False)
    stored = model.replay_buffer.actions[30:40]
    assert stored.mean() < -0.8
    with th.no_grad():
        model.policy.averaged_actor.mu.bias.fill_(5.0)  # which has moved
    model.save(tmp_path / "agent")
    loaded = StableSAC.load(tmp_path / "agent", device="cpu")
    assert loaded.predict(obs, deterministic=True)[0] == pytest.approx(2.0, abs=0.1)


def test_without_its_parts_it_learns_as_delayed_sac():
    """But for the order of an update: so values agree, and no number does exactly."""
    kwargs = {"gamma": 0.7, "tau": 0.2, "learning_rate": 2e-2, "batch_size": 32}
    values = []
    for model in (make(**AS_SADR, **kwargs).learn(90), make(cls=DelayedSAC, **kwargs).learn(90)):
        batch = model.replay_buffer.sample(200)
        with th.no_grad():
            values.append(float(th.cat(model.critic(batch.observations, batch.actions)).mean()))
        assert model.policy.state_dict().keys() == make(cls=DelayedSAC).policy.state_dict().keys()
    assert values[0] == pytest.approx(values[1], rel=0.1)


def test_it_learns_to_be_where_rewards_are():
    class Near(Drift):
        def step(self, action):
            state, _, *rest = super().step(action)
            return state, -float((state[0] - 0.5) ** 2), *rest

    env = delayed(2)
    env.env = Near(length=25)
    kwargs = {"gamma": 0.8, "tau": 0.02, "learning_rate": 1e-2, "batch_size": 64, "learning_starts": 60}
    model = make(env, **kwargs).learn(260)
    obs, _ = env.reset(seed=5)
    states = []
    for _ in range(25):
        obs, *_, info = env.step(model.predict(obs, deterministic=True)[0])
        states.append(info["undelayed_observation"][0])
    assert np.mean(states[-8:]) == pytest.approx(0.5, abs=0.25)


def test_each_hidden_layer_of_the_critics_is_normalised_before_its_activation(tmp_path):
    networks = {"net_arch": {"pi": [8], "qf": [16, 12]}}
    learned = make(delayed(3), critic_layer_norm=True, policy_kwargs=networks).learn(25)
    learned.save(tmp_path / "agent.zip")
    model = StableSAC.load(tmp_path / "agent.zip", device="cpu")
    model.replay_buffer = learned.replay_buffer
    batch = model.replay_buffer.sample(9)
    z = model.policy.state_normalizer(batch.observations[UNDELAYED])
    x = th.cat([z, batch.actions], dim=1)  # (B, obs_dim + act_dim)
    for network, values in zip(model.critic.q_networks, model.critic(batch.observations, batch.actions), strict=True):
        hidden, weights = x, [*network.parameters()]
        for k in (0, 4):  # weight, bias, gain, offset of a hidden layer
            weight, bias, gain, offset = weights[k : k + 4]
            hidden = hidden @ weight.T + bias
            hidden = (hidden - hidden.mean(1, keepdim=True)) / (hidden.var(1, keepdim=True, correction=0) + 1e-5).sqrt()
            hidden = (hidden * gain + offset).clamp(min=0)
        th.testing.assert_close(values, hidden @ weights[8].T + weights[9], rtol=1e-4, atol=1e-5)
    assert not [layer for layer in model.actor.modules() if isinstance(layer, th.nn.LayerNorm)]


# ------------------------------------------------------------------------------------------------------------ files


def test_scales_are_part_of_the_agent(tmp_path):
    model = make(delayed(3)).learn(30)
    model.save(tmp_path / "agent.zip")
    loaded = StableSAC.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.policy.return_scale.value == model.policy.return_scale.value != 1
    th.testing.assert_close(loaded.policy.state_dict(), model.policy.state_dict(), rtol=0, atol=0)
    obs, _ = delayed(3).reset(seed=0)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    assert loaded.target_entropy == model.target_entropy == -0.5


def test_a_replay_that_was_loaded_is_scaled_as_by_whom_it_is_of(tmp_path):
    """By an agent that has seen no reward; the other's count is of all its steps, and the replay keeps the newest."""
    for size in (500, 90):
        teacher = make(delayed(3), buffer_size=size, learning_starts=1000).learn(120)
        teacher.save_replay_buffer(tmp_path / "replay")
        model = make(delayed(3), buffer_size=size, seed=1)
        model.load_replay_buffer(tmp_path / "replay")
        own, theirs = model.policy.return_scale, teacher.policy.return_scale
        assert own.value == pytest.approx(float(theirs.value), rel=1e-6 if size == 500 else 0.5) and own.value != 1
        assert own.count == pytest.approx(min(size, 120), abs=1)
        before = {name: x.clone() for name, x in own.state_dict().items()}
        model.load_replay_buffer(tmp_path / "replay")  # its own count by now
        assert before == dict(own.state_dict())


def test_rewards_that_vec_normalize_normalises_too_are_warned_of():
    env = VecNormalize(make_vec_env(lambda: delayed(3), 1), norm_obs_keys=["observation"])
    with pytest.warns(UserWarning, match="VecNormalize normalises rewards, and StableSAC scales them"):
        make(env).learn(10)
    for kwargs, norm_reward in (({"scale_rewards": False}, True), ({}, False)):
        env = VecNormalize(make_vec_env(lambda: delayed(3), 1), norm_obs_keys=["observation"], norm_reward=norm_reward)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            make(env, **kwargs).learn(10)


def test_beside_vec_normalize():
    env = VecNormalize(make_vec_env(lambda: with_rewards(7.0), 2), gamma=0.7)
    model = make(env, cls=SAID, **QUICK).learn(260)
    batch = model.replay_buffer.sample(100, env=env)
    values = model._stored_values(batch.observations, batch.actions)  # in the task's own rewards
    np.testing.assert_allclose(values, 7 / (1 - 0.7), rtol=0.15)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"policy_delay": 0}, "policy_delay must be a whole number, at least 1, got 0"),
        ({"policy_delay": 1.5}, "policy_delay must be a whole number, at least 1, got 1.5"),
        ({"actor_averaging": 1.0}, r"actor_averaging is a decay in \[0, 1\), got 1.0"),
        ({"actor_averaging": -0.1}, "got -0.1"),
    ],
)
def test_settings_out_of_range(given, message):
    with pytest.raises(ValueError, match=message):
        make(**given)


def test_environments_in_processes_teach_the_same_scale():
    """They hand out rewards in float64."""
    scales = []
    for dtype in (np.float32, np.float64):
        env = make_vec_env(pendulum, 2)
        env.unwrapped.buf_rews = env.unwrapped.buf_rews.astype(dtype)
        scales.append(make(env, learning_starts=1000).learn(60).policy.return_scale.state_dict())
    th.testing.assert_close(*scales, rtol=0, atol=0)


@pytest.mark.parametrize("cls", [DelayedSAC, StableSAC, SAID])
def test_policies_are_sent_to_other_processes_as_sb3s_are(cls):
    """``SubprocVecEnv.set_attr("opponent", model.policy)`` does so, for self-play."""
    model = make_agent(cls=cls).learn(25)
    policy = pickle.loads(pickle.dumps(model.policy))
    obs = observe()
    np.testing.assert_array_equal(*(each.predict(obs, deterministic=True)[0] for each in (policy, model.policy)))


@pytest.mark.parametrize("cls", [DelayedSAC, StableSAC])
def test_the_actor_of_an_agent_without_average_answers_for_one_that_has_it(cls, tmp_path):
    """Until the average moves; what was learned before is of another actor."""
    scales = {} if cls is DelayedSAC else {"actor_averaging": 0.0}
    given, model = make_agent(cls=cls, **scales).learn(25), make().learn(30)
    for source in (given.get_parameters(), tmp_path / "given.zip"):
        given.save(tmp_path / "given.zip")
        model.set_parameters(source, exact_match=False)
        th.testing.assert_close(model.policy.averaged_actor.state_dict(), model.actor.state_dict())
        own = {name: x for name, x in model.actor.state_dict().items() if name in given.actor.state_dict()}
        th.testing.assert_close(own, {name: given.actor.state_dict()[name] for name in own})
        assert model.policy.training_episodes.count == 0
    if cls is StableSAC:
        assert StableSAC.load(tmp_path / "given.zip", actor_averaging=0.9).actor_averaging == 0.9


@pytest.mark.parametrize(
    ("name", "saved", "asked"),
    [("actor_averaging", 0.9998, 0.0), ("scale_rewards", True, False), ("critic_layer_norm", False, True)],
)
def test_a_load_with_other_networks_names_what_the_file_has(tmp_path, name, saved, asked):
    make().save(tmp_path / "stable.zip")
    with pytest.raises(SavedFileError, match=rf"saved with {name}={saved}: leave out") as found:
        StableSAC.load(tmp_path / "stable.zip", **{name: asked})
    assert "[]" not in str(found.value)
    assert StableSAC.load(tmp_path / "stable.zip", batch_size=17).batch_size == 17


def test_states_are_looked_at_also_where_the_replay_is_shorter_than_the_training():
    model = make(delayed(3), buffer_size=60, train_freq=5).learn(150)
    assert model.policy.state_normalizer.fitted_at > 150 / 1.1 - 1


def test_states_are_looked_at_when_there_are_a_tenth_more():
    model = make(delayed(3), train_freq=5).learn(100)
    normalizer = model.policy.state_normalizer
    normalizer.fitted_at.fill_(100.0)
    normalizer.mean.fill_(7.0)
    for n_steps, is_due in ((109, False), (111, True)):
        model.num_timesteps = n_steps
        model._look_at_states()
        assert bool((normalizer.mean != 7.0).any()) == is_due


def test_a_full_replay_is_scaled_from_its_oldest_step_on(tmp_path):
    """Steps 30 to 119, of episodes that begin at 0, 50 and 100: the longest is whole."""
    teacher = make(delayed(3, length=50), buffer_size=90, learning_starts=1000).learn(120)
    teacher.save_replay_buffer(tmp_path / "replay")
    model = make(delayed(3, length=50), buffer_size=90)
    model.load_replay_buffer(tmp_path / "replay")
    assert model.policy.return_scale.largest == pytest.approx(sum(0.99**k for k in range(50)))
