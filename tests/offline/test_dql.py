"""Diffusion Q-learning against closed forms: the schedule, the sampler, Q's target, two modes, and a better mode."""

import pickle

import numpy as np
import pytest
import torch as th
from small_task import Drift, delayed
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_bc import demonstrations
from torch.nn import functional as F

from sb3_said.files.archive import SavedFileError, save_tree
from sb3_said.files.checkpoint import restore_training, training_state
from sb3_said.offline import DQL, Dataset, DQLConfig
from sb3_said.offline.dql import schedule
from sb3_said.offline.learning import take_statistics

SMALL = {"hidden": 32, "n_candidates": 4}


def make(env=None, diffusion_kwargs=(), **kwargs):
    env = Drift() if env is None else env
    given = SMALL | dict(diffusion_kwargs)
    return DQL("MlpPolicy", env, diffusion_kwargs=given, seed=0, device="cpu", buffer_size=100, **kwargs)


def observe(model, n=5):
    """Return n observations as a deployed agent gets them, of ages 0 and more."""
    space = model.observation_space
    space.seed(0)
    rows = [space.sample() for _ in range(n)]
    if not isinstance(rows[0], dict):
        return np.stack(rows)
    batch = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    return batch | {"delay": np.round(batch["delay"])}


def test_vec_normalize_scales_the_rewards_of_logs_as_it_would_in_play():
    data = demonstrations(8)
    data.rewards[:] = np.random.default_rng(0).normal(-30.0, 10.0, len(data))
    env = VecNormalize(DummyVecEnv([delayed]), norm_obs_keys=["observation"], gamma=0.9)
    model = make(env)
    model.take_dataset(data)
    played = VecNormalize(DummyVecEnv([delayed]), norm_obs=False, gamma=0.9)
    for reward, ends in zip(data.rewards, data.ends, strict=True):
        played._update_reward(np.array([reward]))
        played.returns[ends] = 0.0
    assert env.ret_rms.var == pytest.approx(played.ret_rms.var, rel=1e-3)
    rewards = model.replay_buffer.sample(500, env=env).rewards
    assert rewards.std() > 0.05 and rewards.abs().max() < 1.0
    env.training = False  # a deployed one stays as it is
    model.take_dataset(demonstrations(5))
    assert env.ret_rms.var == pytest.approx(played.ret_rms.var, rel=1e-3)


def test_vec_normalize_learns_the_states_of_long_logs_exactly():
    env = VecNormalize(DummyVecEnv([Drift]), norm_reward=False)
    states = np.full((200_000, 2), 0.1, np.float32)  # which float32 would sum up to a hundredth more
    take_statistics(env, Dataset(states, states[:, :1], states[:, 0], *np.zeros((2, len(states)), bool), states[-1:]))
    np.testing.assert_allclose(env.obs_rms.mean, 0.1, rtol=1e-5)


@pytest.mark.parametrize("n_steps", [1, 5, 20])
def test_the_schedule_is_variance_preserving(n_steps):
    config = DQLConfig(denoising_steps=n_steps, beta_min=0.2, beta_max=7.0)
    t = th.arange(1, n_steps + 1) / n_steps
    expected = th.exp(-0.2 * t - 6.8 * t**2 / 2)  # the integral of beta(t) = 0.2 + 6.8 t
    th.testing.assert_close(schedule(config).cumprod(0), expected)


def test_with_the_true_noise_the_sampler_ends_at_the_data(monkeypatch):
    """All data at one action: the noise in a^i is known, and every sample must end there."""
    actor = make().actor

    def noise_of(features, action, step):
        product = actor.products[step, None]
        return (action - product.sqrt() * 0.3) / (1 - product).sqrt()

    monkeypatch.setattr(actor, "noise_of", noise_of)
    th.testing.assert_close(actor.sample(th.zeros(50, 2)), th.full((50, 1), 0.3))


def test_the_posterior_of_normal_data_keeps_its_spread(monkeypatch):
    """Data N(0, 0.2^2): with the best noise estimate, E[noise | a^i], and many steps, samples have that spread."""
    model = make(diffusion_kwargs={"denoising_steps": 100, "beta_max": 5.0})
    actor, variance = model.actor, 0.04

    def noise_of(features, action, step):
        product = actor.products[step, None]
        return (1 - product).sqrt() / (product * variance + 1 - product) * action

    monkeypatch.setattr(actor, "noise_of", noise_of)
    with th.random.fork_rng():
        th.manual_seed(0)
        samples = actor.sample(th.zeros(4000, 2))
    assert samples.std().item() == pytest.approx(0.2, rel=0.08) and abs(samples.mean().item()) < 0.02


def test_two_modes_are_both_drawn_with_the_noise_that_the_loss_asks_for(monkeypatch):
    """Data at +-0.5: E[noise | a^i] has a closed form. It minimises the loss, and leads to both modes alike."""
    model, mode = make(diffusion_kwargs={"denoising_steps": 20}), 0.5
    actor = model.actor

    def best(features, noised, step, sharpness=1.0):
        product = actor.products[step, None]
        clean = mode * th.tanh(sharpness * product.sqrt() * mode * noised / (1 - product))
        return (noised - product.sqrt() * clean) / (1 - product).sqrt()

    def loss_of(noise_of):
        monkeypatch.setattr(actor, "noise_of", noise_of)
        with th.random.fork_rng():
            th.manual_seed(0)
            action = mode * (2 * th.randint(2, (50_000, 1)) - 1.0)
            return actor.imitation_loss(th.zeros(50_000, 2), action).item()

    blunt, sharp = (loss_of(lambda *given, s=s: best(*given, sharpness=s)) for s in (0.7, 1.4))
    assert loss_of(best) < min(blunt, sharp) - 5e-4
    with th.random.fork_rng():
        th.manual_seed(1)
        samples = actor.sample(th.zeros(4000, 2))
    near = ((samples - th.tensor([-mode, mode])).abs() < 0.15).float().mean(0)
    assert near.min() > 0.45


@pytest.mark.parametrize("reconciled", [False, True])
def test_a_target_is_the_reward_and_the_smaller_q_of_the_averaged_actors_action(reconciled):
    model = make(delayed(2), gamma=0.9, delay_reconciled_critic=reconciled)
    model.take_dataset(demonstrations(5))
    batch = model.replay_buffer.sample(16)
    dones = (th.arange(16) % 2)[:, None].float()
    with th.no_grad():  # the actor that is trained is another one
        for parameter in model.actor.parameters():
            parameter.zero_()
    th.manual_seed(3)
    target = model.target_q(batch.rewards, batch.next_observations, dones)
    th.manual_seed(3)
    action = model.policy.actor_target.sample(batch.next_observations)
    for i in range(16):
        row = {key: value[i : i + 1] for key, value in batch.next_observations.items()}
        with th.no_grad():
            q = min(float(q) for q in model.critic_target(row, action[i : i + 1]))
        expected = batch.rewards[i].item() + (0.0 if i % 2 else 0.9 * q)
        assert target[i].item() == pytest.approx(expected, abs=1e-5)


def test_decisions_follow_softmax_of_the_smaller_q(monkeypatch):
    model = make(diffusion_kwargs={"n_candidates": 3})
    candidates = th.tensor([[-0.5], [0.0], [0.5]])
    monkeypatch.setattr(model.actor, "sample", lambda obs, n, generator=None: candidates.repeat(len(obs), 1))
    monkeypatch.setattr(
        model.policy.critic_target, "forward", lambda obs, a: (2 * a, 2 * a + 1)
    )  # the first is smaller
    drawn = model.policy.decide(th.zeros(6000, 2))[:, 0]
    expected = (2 * candidates[:, 0]).softmax(0)
    found = th.stack([(drawn == c).float().mean() for c in candidates[:, 0]])
    th.testing.assert_close(found, expected, atol=0.03, rtol=0)


def test_eta_makes_it_climb_q():
    """Critics that prefer large actions pull the actor there; with eta 0 it stays at the data."""

    def mean_action(eta):
        model = make(learning_rate=1e-2, diffusion_kwargs={"eta": eta, "max_grad_norm": None})
        model.take_dataset(demonstrations(10))
        model.critic.forward = lambda obs, a: (a + 2.0, a + 2.0)
        model._descend = lambda network, loss, original=model._descend: (
            network is model.critic or original(network, loss)
        )
        model.set_logger(configure(format_strings=[]))
        model.train(25, 64)
        with th.no_grad():
            return model.actor.sample(model.replay_buffer.sample(300).observations).mean().item()

    assert mean_action(20.0) > mean_action(0.0) + 0.3


def ready(**kwargs):
    model = make(**kwargs)
    model.take_dataset(demonstrations(5))
    model.set_logger(configure(format_strings=[]))
    return model


def test_either_critic_is_climbed_in_sizes_of_the_other(monkeypatch):
    """Q of 2 and -4: it climbs 2 / 4, or -4 / 2."""
    model, seen = ready(), []
    monkeypatch.setattr(model.critic, "forward", lambda obs, a: (0 * a + 2.0, 0 * a - 4.0))
    monkeypatch.setattr(model, "_descend", lambda network, loss: None)
    monkeypatch.setattr(model.logger, "record_mean", lambda name, value: seen.append((name, round(value, 5))))
    np.random.seed(0)
    for _ in range(20):
        model.train(1, 4)
    assert {value for name, value in seen if name == "train/q_loss"} == {-2 / 4, 4 / 2}


def test_targets_follow_their_networks():
    """The critics' after each update, the actor's from ``ema_start`` on after every ``ema_every``."""
    model = ready(tau=0.1, diffusion_kwargs={"ema_start": 3, "ema_every": 2, "ema_decay": 0.7})
    pairs = {
        "critic": (model.critic, model.critic_target, [0.1] * 6),
        "actor": (model.actor, model.policy.actor_target, [0.0, 0.0, 0.0, 0.3, 0.0, 0.3]),
    }
    for k in range(6):
        before = {name: [p.clone() for p in pair[1].parameters()] for name, pair in pairs.items()}
        model.train(1, 8)
        for name, (network, target, rates) in pairs.items():
            for own, old, new in zip(network.parameters(), before[name], target.parameters(), strict=True):
                th.testing.assert_close(new, old + rates[k] * (own - old))


@pytest.mark.parametrize("max_grad_norm", [1e-3, None])
def test_long_gradients_are_clipped(max_grad_norm):
    model, norms = ready(diffusion_kwargs={"max_grad_norm": max_grad_norm}), []
    for network in (model.actor, model.critic):
        network.optimizer.register_step_pre_hook(
            lambda given, *_: norms.extend(
                th.stack([p.grad.norm() for p in group["params"]]).norm().item() for group in given.param_groups
            )
        )
    model.train(1, 8)
    assert len(norms) == 2 and all((norm <= 1.001e-3) == (max_grad_norm is not None) for norm in norms)


@pytest.mark.parametrize("lr_decay", [False, True])
def test_the_rate_falls_to_0_by_a_cosine(lr_decay, monkeypatch, tmp_path):
    rates = []
    monkeypatch.setattr(
        DQL, "_descend", lambda self, network, loss: rates.append(network.optimizer.param_groups[0]["lr"])
    )
    model = make(learning_rate=0.1, lr_decay=lr_decay)
    for _ in range(2):  # a second training starts as high
        model.learn_offline(demonstrations(2), 10)
    expected = 0.05 * (1 + np.cos(np.pi * np.arange(10) / 10)) if lr_decay else np.full(10, 0.1)
    np.testing.assert_allclose(rates, np.tile(expected.repeat(2), 2))  # of critics and actor
    model.save(tmp_path / "dql.zip")
    for again in (DQL.load(tmp_path / "dql.zip", device="cpu"), pickle.loads(pickle.dumps(model))):
        assert again.lr_schedule(0.5) == pytest.approx(0.05 if lr_decay else 0.1)


@pytest.mark.parametrize("delay", [None, 2])
def test_it_learns_is_saved_and_repeats(delay, tmp_path):
    model = make(None if delay is None else delayed(delay), diffusion_kwargs={"ema_start": 2, "ema_every": 1})
    before = [p.clone() for p in model.policy.actor_target.parameters()]
    model.learn_offline(demonstrations(5), 4)
    after = list(model.policy.actor_target.parameters())
    assert not all(th.equal(a, b) for a, b in zip(before, after, strict=True))
    model.save(tmp_path / "dql.zip")
    loaded = DQL.load(tmp_path / "dql.zip", device="cpu")
    obs = observe(model)
    answer = model.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], answer)
    rows = [{k: v[i] for k, v in obs.items()} if isinstance(obs, dict) else obs[i] for i in range(5)]
    np.testing.assert_array_equal([model.predict(row, deterministic=True)[0] for row in rows], answer)
    assert not np.array_equal(model.predict(obs)[0], model.predict(obs)[0])  # it is a distribution
    assert model.policy.config == loaded.policy.config and loaded._n_updates == 4
    other = DQL.load(tmp_path / "dql.zip", device="cpu", diffusion_kwargs={"eta": 3.0})
    assert other.policy.config == DQLConfig(**SMALL, ema_start=2, ema_every=1, eta=3.0)


@pytest.mark.parametrize("noise", [{"denoising_steps": 9}, {"beta_min": 0.2}, {"beta_max": 5.0}], ids=str)
def test_weights_are_not_taken_under_another_noise(noise, tmp_path):
    """They would have the same shapes, and answer something else."""
    other, model = make(diffusion_kwargs=noise), make()
    model.save(tmp_path / "new.zip")
    other.set_parameters(tmp_path / "new.zip")  # which have learned nothing
    model.learn_offline(demonstrations(5), 2)
    model.save(tmp_path / "saved.zip")
    save_tree(tmp_path / "checkpoint.zip", training_state(model, keeps_replay=False))
    name, value = next(iter(noise.items()))
    told = f"its actor has learned with .*'{name}': {getattr(DQLConfig(**SMALL), name)}.*, and this agent has .*{value}"
    with pytest.raises(SavedFileError, match=told):
        DQL.load(tmp_path / "saved.zip", device="cpu", diffusion_kwargs=noise)
    for path in ("saved.zip", "checkpoint.zip"):
        with pytest.raises(SavedFileError, match=told):
            other.set_parameters(tmp_path / path)
    other.take_dataset(demonstrations(5))
    with pytest.raises(SavedFileError, match=told):
        restore_training(other, tmp_path / "checkpoint.zip")


def test_only_with_state_augmentation_it_reads_the_actions_since():
    for augment_state in (True, False):
        model = make(delayed(2), augment_state=augment_state)
        obs = {"observation": np.zeros(2), "action_history": np.full((2, 1), 0.5), "delay": np.array([2.0])}
        other = obs | {"action_history": np.full((2, 1), -0.5)}
        features = [model.actor._features(model.policy.obs_to_tensor(o)[0]) for o in (obs, other)]
        assert th.equal(*features) != augment_state


def test_critics_of_the_true_state_choose_nothing_in_play(monkeypatch):
    model = make(delayed(2), delay_reconciled_critic=True)
    monkeypatch.setattr(model.policy.critic_target, "forward", lambda *_: pytest.fail("it reads the true state"))
    assert np.isfinite(model.predict(observe(model), deterministic=True)[0]).all()


@pytest.mark.parametrize(
    "given",
    [{"use_sde": True}, {"policy_kwargs": {"n_critics": 3}}, {"policy_kwargs": {"net_arch": {"pi": [7], "qf": [9]}}}],
)
def test_arguments_of_another_actor_and_other_critics_are_refused(given):
    with pytest.raises(ValueError, match="DQL has two critics and a diffusion actor of its own, got"):
        make(**given)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"n_steps": 5}, "DQL has no setting n_steps; did you mean denoising_steps"),
        ({"n_candidates": 0}, "n_candidates is 0, expected at least 1"),
        ({"beta_max": 0.01}, "0 < beta_min < beta_max"),
        ({"time_embedding": 7}, "expected an even number"),
        ({"max_grad_norm": -1.0}, "max_grad_norm is -1.0, expected a number above 0, or None"),
        ({"denoising_steps": 2.5}, "denoising_steps is 2.5, expected a whole number"),
        ({"eta": "1"}, "eta is '1', expected a finite number"),
        ({"beta_max": np.inf}, "beta_max is inf, expected a finite number"),
        ({"denoising_steps": 10**9}, "denoising_steps is 1000000000, expected at most 1000"),
        ({"n_candidates": 10**9}, "n_candidates is 1000000000, expected at most 10000"),
        ({"ema_start": -5}, "ema_start is -5, expected at least 0"),
    ],
)
def test_bad_settings_are_named(setting, message):
    with pytest.raises(ValueError, match=message):
        make(diffusion_kwargs=setting)


def test_a_naive_loss_is_the_imitation_loss():
    actor = make().actor
    obs, action = th.randn(8, 2), th.rand(8, 1) * 2 - 1
    th.manual_seed(5)
    loss = actor.imitation_loss(obs, action)
    th.manual_seed(5)
    step, noise = th.randint(5, (8,)), th.randn(8, 1)
    beta = 1 - schedule(actor.config)
    for i in range(8):
        noised = action[i]
        kept = float(np.prod([1 - beta[k].item() for k in range(step[i] + 1)]))
        noised = kept**0.5 * action[i] + (1 - kept) ** 0.5 * noise[i]
        guess = actor.noise_of(obs[i : i + 1], noised[None], step[i : i + 1])
        action[i] = F.mse_loss(guess[0], noise[i]).item()
    assert loss.item() == pytest.approx(action.mean().item(), rel=1e-5)


def test_the_clean_action_is_clipped_in_every_step(monkeypatch):
    """As the authors' code does: else a guess far outside leads the later steps to where no data is."""
    actor, seen = make().actor, []
    monkeypatch.setattr(actor, "noise_of", lambda features, action, step: seen.append(action) or 0 * action - 50.0)
    assert th.equal(actor.sample(th.zeros(20, 2)), th.ones(20, 1))
    assert max(action.abs().max() for action in seen) < 10
