"""SAID: an expert that learns as DelayedSAC does, a planner that answers, and files that bring back both."""

import inspect
import warnings
import zipfile
from dataclasses import fields

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_task import Drift, delayed
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from sb3_said import SAID, DelayedObservationWrapper, DelayedSAC, PlannerConfig
from sb3_said.delays import TotalDelay, UniformDelay

PLANNER = {
    "d_model": 32,
    "depth": 1,
    "horizon": 3,
    "batch_size": 16,
    "sampling_steps": 2,
    "n_candidates": 4,
    "temperature": 0.5,
}


def make(env=None, cls=SAID, policy="MlpPolicy", planner_kwargs=(), **kwargs):
    arguments = {"learning_starts": 20, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    arguments["policy_kwargs"] = {"net_arch": [32]}
    if cls is SAID:
        arguments |= {"planner_kwargs": PLANNER | dict(planner_kwargs), "planner_gradient_steps": 5}
    return cls(policy, delayed() if env is None else env, **(arguments | kwargs))


def observe(n=7, env=None):
    """Return n observations of one episode, as a batch."""
    env = delayed() if env is None else env
    rows = [env.reset(seed=1)[0]]
    rows += [env.step(np.array([0.3 * k - 1.0], np.float32))[0] for k in range(n - 1)]
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}


def rows_of(batch):
    return [{key: value[i] for key, value in batch.items()} for i in range(len(batch["delay"]))]


def answer(model, obs, deterministic=True):
    return model.predict(obs, deterministic=deterministic)[0]


@pytest.fixture(scope="module")
def trained():
    """A trained agent; tests must leave it as it is."""
    return make().learn(80)


@pytest.fixture
def saved(trained, tmp_path):
    trained.save(tmp_path / "said.zip")
    return tmp_path / "said.zip"


# ---------------------------------------------------------------------------------------------------- the expert


def same_replay(first, second):
    first, second = first.replay_buffer.state_dict(), second.replay_buffer.state_dict()
    keys = ("observations", "actions", "rewards", "ages", "steps")
    return all(np.array_equal(first[key], second[key]) for key in keys)


@pytest.mark.parametrize("planner_train_freq", [None, 30])
def test_the_expert_learns_and_acts_exactly_as_without_a_planner(planner_train_freq):
    said = make(planner_train_freq=planner_train_freq).learn(100)
    sac = make(cls=DelayedSAC).learn(100)
    assert said.policy.planner_is_trained and said._n_updates == sac._n_updates == 80
    assert same_replay(said, sac)  # collection never asked the planner
    expected = sac.policy.state_dict()
    th.testing.assert_close({key: said.policy.state_dict()[key] for key in expected}, expected, rtol=0, atol=0)
    th.testing.assert_close(said.log_ent_coef, sac.log_ent_coef, rtol=0, atol=0)


def test_the_expert_answers_until_the_planner_is_trained():
    said, obs = make(), observe()
    sac = make(cls=DelayedSAC)
    np.testing.assert_allclose(answer(said, obs), answer(sac, obs), rtol=1e-5)
    with pytest.raises(ValueError, match="not trained yet"), said.policy.answering("planner"):
        pass
    said.learn(60)
    by_default = answer(said, obs)
    with said.policy.answering("expert"):
        by_expert = answer(said, obs)
        with said.policy.answering("planner"):
            assert np.array_equal(answer(said, obs), by_default)
        assert np.array_equal(answer(said, obs), by_expert)
    assert np.array_equal(answer(said, obs), by_default)
    assert not np.allclose(by_default, by_expert)
    with pytest.raises(ValueError, match="'nobody'"), said.policy.answering("nobody"):
        pass


class Asked(BaseCallback):
    """Notes what predict answers at every step, and after the planner's training."""

    def __init__(self, obs):
        super().__init__()
        self.obs, self.ours, self.experts = obs, [], []

    def _on_step(self):
        self.ours.append(answer(self.model, self.obs))
        with self.model.policy.answering("expert"):
            self.experts.append(answer(self.model, self.obs))
        return True


def test_callbacks_are_answered_by_the_expert_while_learning(trained, tmp_path):
    evaluation, asked = EvalCallback(Monitor(delayed()), eval_freq=10, n_eval_episodes=2, verbose=0), Asked(observe())
    model = make(planner_train_freq=30).learn(100, CallbackList([evaluation, asked]))
    sac_evaluation = EvalCallback(Monitor(delayed()), eval_freq=10, n_eval_episodes=2, verbose=0)
    make(cls=DelayedSAC).learn(100, sac_evaluation)
    np.testing.assert_allclose(evaluation.evaluations_results, sac_evaluation.evaluations_results, rtol=1e-4)
    assert np.array_equal(asked.ours, asked.experts)
    assert not np.allclose(answer(model, asked.obs), asked.ours[-1])  # and by the planner afterwards


# ---------------------------------------------------------------------------------------------------- the planner


def test_value_is_the_smallest_critic(trained):
    policy = trained.policy
    states, actions = th.randn(3, 4, 5, 2), th.rand(3, 4, 5, 1) * 2 - 1
    critics = policy.critic({"undelayed_observation": states.reshape(-1, 2)}, actions.reshape(-1, 1))
    expected = th.minimum(*critics).reshape(3, 4, 5)
    assert not th.equal(critics[0], critics[1])
    th.testing.assert_close(policy.value(states, actions), expected)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_candidate_of_the_highest_value_after_the_decision_answers(trained, delay):
    policy, planner = trained.policy, trained.policy.planner
    obs = rows_of(observe())[delay]  # ages grow from 0 at an episode's start
    assert obs["delay"] == delay
    batch = {key: th.as_tensor(value[None]) for key, value in obs.items()}
    ages = batch["delay"][:, 0].long()
    plan = planner.plan(
        batch["observation"], batch["action_history"], ages, value_fn=policy.value, noise=policy._noise_of(batch)
    )
    assert plan.values.shape == (1, 4) and len(plan.values.unique()) > 1
    futures = plan.states[0, :, delay + 1 :], plan.actions[0, :, delay + 1 :]
    scores = th.minimum(
        *(
            th.stack([policy.critic({"undelayed_observation": s}, a)[i][:, 0] for s, a in zip(*futures, strict=True)])
            for i in (0, 1)
        )
    ).mean(1)
    th.testing.assert_close(plan.values[0], scores)
    chosen = plan.actions[0, scores.argmax(), delay].numpy()
    np.testing.assert_allclose(answer(trained, obs), 2.0 * chosen, rtol=1e-6, atol=1e-6)  # actions run from -2 to 2


def test_at_temperature_0_nothing_is_drawn_and_no_critic_asked(saved, monkeypatch):
    model, batch = SAID.load(saved, device="cpu"), observe()
    model.set_planner(temperature=0.0)
    monkeypatch.setattr(model.policy.critic, "q_values", None)
    before = th.get_rng_state()
    for deterministic in (True, False):
        obs = {key: th.as_tensor(value) for key, value in batch.items()}
        plan = model.policy.planner.plan(
            obs["observation"], obs["action_history"], obs["delay"][:, 0].long(), temperature=0.0
        )
        np.testing.assert_allclose(answer(model, batch, deterministic), 2.0 * plan.action, rtol=1e-5, atol=1e-6)
    assert th.equal(th.get_rng_state(), before)


def test_deterministic_noise_is_the_observations_own(trained):
    # One noise for every observation makes the same candidates win at every step: on Hopper-v5 an agent of return 3,000
    # fell to 351 with it.
    policy = trained.policy
    rows = [{key: th.as_tensor(value[None]) for key, value in row.items()} for row in rows_of(observe(4))]
    noises = [policy._noise_of(row) for row in rows]
    assert all(not th.equal(noises[0], other) for other in noises[1:])
    before = th.get_rng_state()
    shuffled = dict(reversed(rows[0].items()))
    assert th.equal(policy._noise_of(shuffled), noises[0]) and th.equal(th.get_rng_state(), before)
    assert abs(th.cat([n.flatten() for n in noises]).std() - 1) < 0.1


@pytest.mark.parametrize("who", ["planner", "expert"])
def test_deterministic_answers_repeat_bit_for_bit(trained, saved, who):
    loaded, batch = SAID.load(saved, device="cpu"), observe(9)
    assert loaded.env is None
    with trained.policy.answering(who), loaded.policy.answering(who):
        states = th.get_rng_state(), np.random.get_state()[1].copy()
        expected = answer(trained, batch)
        assert th.equal(states[0], th.get_rng_state()) and np.array_equal(states[1], np.random.get_state()[1])
        th.randn(3), answer(trained, batch, deterministic=False)
        for model in (trained, loaded):
            for size in (9, 4, 1):
                parts = [{key: value[i : i + size] for key, value in batch.items()} for i in range(0, 9, size)]
                assert np.array_equal(np.concatenate([answer(model, part) for part in parts]), expected)
            assert np.array_equal([answer(model, row) for row in rows_of(batch)], expected)


@pytest.mark.parametrize("who", ["planner", "expert"])
def test_deterministic_answers_are_made_row_by_row(trained, monkeypatch, who):
    # Products of larger matrices round differently, on some machines and at some widths.
    owner, method = (trained.policy, "_plan") if who == "planner" else (trained.policy.actor, "forward")
    asked, original = [], getattr(owner, method)

    def ask(observation, *args, **kwargs):
        asked.append(len(observation["delay"]))
        return original(observation, *args, **kwargs)

    monkeypatch.setattr(owner, method, ask)
    with trained.policy.answering(who):
        answer(trained, observe(5))
        answer(trained, observe(5), deterministic=False)
    assert asked == [1] * 5 + [5]


@pytest.mark.parametrize("who", ["planner", "expert"])
def test_other_answers_follow_the_global_seed(trained, who):
    obs = observe()
    with trained.policy.answering(who):
        answers = []
        for seed in (1, 1, 2):
            set_random_seed(seed)
            answers.append(answer(trained, obs, deterministic=False))
    assert np.array_equal(answers[0], answers[1])
    assert not np.array_equal(answers[0], answers[2])
    assert np.abs(answers[0]).max() <= 2.0


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("observation", [np.nan, 0.0], "observation has entries that are NaN"),
        ("action_history", [[0.0], [np.nan]], "action_history has entries that are NaN"),
        ("action_history", np.zeros((3, 1)), "another task or max_delay"),
        ("observation", np.zeros(3), r"observation has the shape \(3,\)"),
        ("delay", [3.0], "max_delay=2"),
        ("delay", [-1.0], r"0\.\.2"),
        ("delay", [0.5], "whole numbers"),
    ],
)
def test_bad_observations_are_refused_before_planning(trained, key, value, message, deterministic, monkeypatch):
    def computed(*_, **__):
        raise AssertionError("the planner was asked")

    monkeypatch.setattr(trained.policy.planner, "plan", computed)
    obs = rows_of(observe())[3] | {key: np.asarray(value, np.float32)}
    with pytest.raises(ValueError, match=message):
        trained.predict(obs, deterministic=deterministic)


def test_a_zeros_sign_changes_no_answer(saved):
    model = SAID.load(saved, device="cpu")
    model.set_planner(temperature=1.0)
    obs = rows_of(observe())[0]  # nothing sent yet: zeros
    negative = {key: np.where(value == 0, np.float32(-0.0), value) for key, value in obs.items()}
    assert any(np.signbit(value).any() and not value.any() for value in negative.values())
    assert np.array_equal(answer(model, negative), answer(model, obs))


def test_a_planner_for_one_age_refuses_others(monkeypatch):
    model = make(planner_kwargs={"mask": "fixed"}).learn(60)
    ages, plan = [], model.policy.planner.plan
    monkeypatch.setattr(
        model.policy.planner, "plan", lambda *args, **kwargs: ages.extend(args[2].tolist()) or plan(*args, **kwargs)
    )
    batch = observe()
    assert batch["delay"][:3, 0].tolist() == [0, 1, 2]
    assert answer(model, batch).shape == (7, 1) and ages == [2] * 7  # s_0 and zeros stand for what was before
    fresher = observe(env=delayed(1, max_delay=2))
    with pytest.raises(ValueError, match=r"age 2 only \(mask='fixed'\).*age 1.*mask='random'"):
        model.predict(fresher)
    with model.policy.answering("expert"):
        assert answer(model, fresher).shape == (7, 1)


def test_nothing_is_left_to_prepare_after_a_warmup(saved, monkeypatch):
    from sb3_said.planner.sampling import DiT1d  # as the planner's cache calls it

    model, other, obs = SAID.load(saved, device="cpu"), SAID.load(saved, device="cpu"), observe()
    made, original = [], DiT1d.modulations
    monkeypatch.setattr(DiT1d, "modulations", lambda self, t: made.append(self) or original(self, t))
    set_random_seed(0)
    model.warmup(7)
    assert len(made) == 1
    answers = [answer(model, obs), answer(model, obs, deterministic=False)]
    assert len(made) == 1
    set_random_seed(0)
    assert np.array_equal(answers, [answer(other, obs), answer(other, obs, deterministic=False)])
    model.set_planner(sampling_steps=3)
    model.warmup()
    assert len(made) == 3
    with pytest.raises(ValueError, match="batch_size is 0, expected at least 1"):
        model.warmup(0)


@pytest.mark.parametrize("planner_kwargs", [{}, {"mask": "fixed"}])
def test_every_agent_can_be_warmed_up(planner_kwargs):
    for model in (make(planner_kwargs=planner_kwargs), make("Pendulum-v1", planner_kwargs=planner_kwargs)):
        model.warmup()  # the expert answers
        model.policy.planner_updates.fill_(1)
        model.warmup(2)


# ---------------------------------------------------------------------------------------------------- settings


def test_how_the_planner_answers_can_be_changed_and_is_saved(saved, tmp_path):
    model, obs = SAID.load(saved, device="cpu"), observe()
    before = answer(model, obs)
    assert model.planner_kwargs == PLANNER
    model.set_planner(temperature=3.0, n_candidates=9, sampling_steps=3)
    assert not np.allclose(answer(model, obs), before)
    model.set_planner(temperature=0.3)
    changes = {"temperature": 0.3, "n_candidates": 9, "sampling_steps": 3}
    assert model.planner_kwargs == PLANNER | changes
    model.save(tmp_path / "changed")
    again = SAID.load(tmp_path / "changed", env=delayed(), device="cpu")
    assert again.policy.planner.config == PlannerConfig(**PLANNER | changes)
    assert np.array_equal(answer(again, obs), answer(model, obs))
    model.set_planner(**{name: getattr(PlannerConfig(**PLANNER), name) for name in changes})
    assert np.array_equal(answer(model, obs), before)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"depth": 2}, "got depth"),
        ({"temperature": -1.0}, "temperature is -1"),
        ({"n_candidates": 0}, "n_candidates is 0"),
        ({"temprature": 0.5}, "got temprature"),
        ({"solver": "euler"}, "solver"),
    ],
)
def test_settings_that_cannot_be_changed_are_refused(saved, settings, message):
    model = SAID.load(saved, device="cpu")
    before = answer(model, observe())
    with pytest.raises(ValueError, match=message):
        model.set_planner(**settings)
    assert model.planner_kwargs == PLANNER and np.array_equal(answer(model, observe()), before)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"planner_kwargs": {"dept": 2}}, "no setting dept; it has depth"),
        ({"planner_kwargs": {"horizon": 1}}, "horizon is 1"),
        ({"planner_gradient_steps": 0}, "planner_gradient_steps must be at least 1"),
        ({"planner_train_freq": 0}, "planner_train_freq must be at least 1"),
        ({"planner_newest_fraction": 0.0}, r"in \(0, 1\], got 0"),
        ({"planner_newest_fraction": 1.5}, r"in \(0, 1\], got 1.5"),
        ({"delay_reconciled_critic": False}, "must read true states"),
    ],
)
def test_arguments_that_cannot_work_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_every_argument_has_a_default_and_is_an_attribute():
    parameters = list(inspect.signature(SAID.__init__).parameters.values())[3:]
    own = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    given = {
        "learning_rate": 0.01,
        "planner_kwargs": PLANNER,
        "planner_gradient_steps": 7,
        "planner_train_freq": 9,
        "planner_newest_fraction": 0.2,
        "planner_terminal_penalty": None,
    }
    assert [p.name for p in own] == list(given) and all(p.default is not p.empty for p in own)
    model = make(**given)
    assert {name: getattr(model, name) for name in given} == given
    assert make(planner_kwargs={}).policy.planner.config.horizon == 3
    assert SAID("MultiInputPolicy", delayed(), buffer_size=100).policy.planner.config == PlannerConfig()


# ---------------------------------------------------------------------------------------------------- files


def test_a_saved_agent_is_json_and_tensors(saved):
    with zipfile.ZipFile(saved) as archive:
        assert sorted(archive.namelist()) == ["metadata.json", "tensors.safetensors", "tree.json"]
        content = b"".join(archive.read(name) for name in archive.namelist())
    assert b":serialized:" not in content and b"cloudpickle" not in content
    assert not content.startswith(b"\x80")


def test_a_file_with_pickles_needs_an_opt_in(trained, tmp_path):
    BaseAlgorithm.save(trained, tmp_path / "pickled")  # SB3's own
    with pytest.raises(ValueError, match=r"runs whatever code.*allow_pickle=True"):
        SAID.load(tmp_path / "pickled")
    loaded = SAID.load(tmp_path / "pickled", device="cpu", allow_pickle=True)
    assert np.array_equal(answer(loaded, observe()), answer(trained, observe()))


def test_another_algorithms_file_is_refused(tmp_path):
    make(cls=DelayedSAC).save(tmp_path / "sac")
    with pytest.raises(ValueError, match="SAID needs a SAIDPolicy, got DelayedSACPolicy"):
        SAID.load(tmp_path / "sac")


def test_a_loaded_agent_learns_on(saved):
    loaded = SAID.load(saved, env=make_vec_env(delayed, n_envs=2), device="cpu")
    before = answer(loaded, observe())
    loaded.learn(80, reset_num_timesteps=False)
    assert loaded.num_timesteps == 160
    assert not np.array_equal(answer(loaded, observe()), before)
    with pytest.raises(ValueError, match="built for max_delay=2, but this environment has max_delay=3"):
        SAID.load(saved, env=delayed(3))
    with pytest.raises(ValueError, match="built for max_delay=2, but this environment has max_delay=3"):
        loaded.set_env(make_vec_env(lambda: delayed(3), n_envs=2))


def test_only_a_planner_of_every_delay_takes_another_one_silently(trained, saved, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SAID.load(saved, env=delayed((0, 2)), device="cpu")
    without_planner = make().learn(80)
    without_planner.policy.planner_updates.zero_()
    without_planner.save(tmp_path / "agent")
    with pytest.warns(UserWarning, match=r"SAID learned under FixedDelay\(delay=2\) and is given EpisodeDelay"):
        SAID.load(tmp_path / "agent", env=delayed((0, 2)), device="cpu")


@pytest.mark.parametrize("delay", [(0, 2), 1, UniformDelay(1, 2)])
def test_a_planner_for_one_age_refuses_environments_of_others(delay, tmp_path):
    with pytest.warns(UserWarning, match="mask='fixed' answers under delay=2 only"):  # the expert may learn there
        make(delayed(delay, max_delay=2), planner_kwargs={"mask": "fixed"})
    model = make(planner_kwargs={"mask": "fixed"}).learn(60)
    model.save(tmp_path / "agent")
    for take in (
        lambda: model.set_env(make_vec_env(lambda: delayed(delay, max_delay=2))),
        lambda: SAID.load(tmp_path / "agent", env=delayed(delay, max_delay=2), device="cpu"),
    ):
        with (
            warnings.catch_warnings(),
            pytest.raises(ValueError, match="mask='fixed' answers under delay=2 only, but this environment"),
        ):
            warnings.simplefilter("error")
            take()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for same in (2, (2, 2), TotalDelay(1, (1, 1))):
            SAID.load(tmp_path / "agent", env=delayed(same), device="cpu")


def test_parameters_and_policy_are_taken_over(trained, tmp_path):
    other, obs = make(seed=3), observe()
    other.set_parameters(trained.get_parameters())
    assert np.array_equal(answer(other, obs), answer(trained, obs))  # with the planner, and that it is trained
    trained.policy.save(tmp_path / "policy")
    policy = type(trained.policy).load(tmp_path / "policy", device="cpu")
    assert np.array_equal(answer(policy, obs), answer(trained, obs))


def test_a_file_brings_its_settings_whatever_the_defaults_are_then(trained, saved, monkeypatch):
    expected, names = trained.policy.planner.config, [field.name for field in fields(PlannerConfig)]
    defaults = list(PlannerConfig.__init__.__defaults__)
    others = {"scored_states": "all", "solver": "dpmsolver++2m", "embed_known": False}
    for name, value in others.items():
        assert getattr(expected, name) == defaults[names.index(name)] != value
        defaults[names.index(name)] = value
    monkeypatch.setattr(PlannerConfig.__init__, "__defaults__", tuple(defaults))
    assert PlannerConfig().solver == "dpmsolver++2m"
    loaded = SAID.load(saved, device="cpu")
    assert loaded.policy.planner.config == expected
    assert np.array_equal(answer(loaded, observe()), answer(trained, observe()))


def test_only_an_untrained_planner_may_be_of_other_settings(trained, tmp_path):
    expert, deeper = make(seed=4), make(planner_kwargs={"depth": 2})
    expert.save(tmp_path / "expert")
    deeper.set_parameters(tmp_path / "expert")
    assert np.array_equal(answer(deeper, observe()), answer(expert, observe()))
    assert len(deeper.policy.planner.network.blocks) == 2
    with pytest.raises(RuntimeError, match="planner"):
        deeper.set_parameters(trained.get_parameters())


# ---------------------------------------------------------------------------------------------------- learning


def test_training_the_planner_of_a_loaded_agent(trained, saved, tmp_path):
    loaded = SAID.load(saved, device="cpu")
    before = answer(loaded, observe())
    with pytest.raises(ValueError, match="replay buffer is empty"):
        loaded.train_planner()
    assert np.array_equal(answer(loaded, observe()), before)
    trained.save_replay_buffer(tmp_path / "replay")
    loaded.load_replay_buffer(tmp_path / "replay")
    loaded.train_planner(3)
    assert loaded.policy.planner_updates == 3
    assert not np.array_equal(answer(loaded, observe()), before)
    with pytest.raises(ValueError, match="gradient_steps >= 1"):
        loaded.train_planner(0)


def test_learning_no_steps_changes_nothing(saved):
    assert not make().learn(0).policy.planner_is_trained
    loaded = SAID.load(saved, env=delayed(), device="cpu")
    before = answer(loaded, observe())
    for reset in (True, False):
        loaded.learn(0, reset_num_timesteps=reset)
        assert np.array_equal(answer(loaded, observe()), before)


def test_learning_no_steps_without_a_replay_trains_no_planner():
    model = make()
    model.num_timesteps = 40  # as of a run that was interrupted before the planner's turn, saved and loaded
    assert not model.learn(0, reset_num_timesteps=False).policy.planner_is_trained


def test_one_unfinished_episode_is_enough_to_learn_from():
    model = make(delayed(length=1000)).learn(40)
    assert model.policy.planner_updates == 5
    assert answer(model, observe()).shape == (7, 1)


def test_a_plain_task_is_delay_0():
    model = make("Pendulum-v1", policy="MultiInputPolicy").learn(60)
    env = gym.make("Pendulum-v1")
    obs = np.stack([env.reset(seed=k)[0] for k in range(3)])
    actions = answer(model, obs)
    assert actions.shape == (3, 1) and np.abs(actions).max() <= 2.0
    assert np.array_equal(np.stack([answer(model, o) for o in obs]), actions)
    assert not np.array_equal(answer(model, obs, deterministic=False), actions)
    with pytest.raises(ValueError, match="NaN"):
        model.predict(obs * np.nan)


def test_evaluate_policy(trained):
    env = Monitor(delayed())
    env.reset(seed=0)
    first = evaluate_policy(trained, env, n_eval_episodes=2, return_episode_rewards=True)[0]
    env.reset(seed=0)
    assert first == evaluate_policy(trained.policy, env, n_eval_episodes=2, return_episode_rewards=True)[0]
    actions = []
    for model in (trained, trained.policy):
        evaluate_policy(model, env, 1, callback=lambda scope, _: actions.append(scope["actions"]))
    assert len(actions) == 24 and all(a.shape == (1, 1) for a in actions)


@pytest.mark.parametrize("env", [delayed, Drift])
def test_normalized_tasks(env):
    is_dict = env is delayed
    vec_env = VecNormalize(
        make_vec_env(env, n_envs=2, seed=0), norm_obs_keys=["observation"] if is_dict else None, gamma=0.9
    )
    model = make(vec_env).learn(120)
    assert model.policy.planner_is_trained
    assert answer(model, vec_env.reset()).shape == (2, 1)

    # The planner's data are in the expert's units, the bootstrapped values in those of the stored rewards.
    buffer, rms = model.replay_buffer, vec_env.obs_rms["observation"] if is_dict else vec_env.obs_rms
    states = buffer.observations[: buffer.size()]
    scaled = np.clip((states - rms.mean) / np.sqrt(rms.var + vec_env.epsilon), -10, 10)
    source = model.make_planner_trainer().source
    np.testing.assert_allclose(source.states[: buffer.size()], scaled, rtol=1e-4, atol=1e-6)
    values = model._stored_values(states[:, 0], buffer.actions[: buffer.size(), 0])
    with th.no_grad():
        critic = model.policy.value(
            th.as_tensor(scaled[:, 0], dtype=th.float32), th.as_tensor(buffer.actions[: len(states), 0])
        )
    np.testing.assert_allclose(values, critic * np.sqrt(vec_env.ret_rms.var + vec_env.epsilon), rtol=1e-4, atol=1e-5)


def test_the_newest_part_of_the_buffer():
    model = make(planner_newest_fraction=0.2, planner_kwargs={"weight_factor": 0.0}).learn(100)
    trainer = model.make_planner_trainer()
    assert trainer._settings["n_windows"] == 20
    assert trainer.source.rows.min() >= 80
    model.planner_newest_fraction = 1.0
    assert model.make_planner_trainer()._settings["n_windows"] == 100


@pytest.mark.parametrize("penalty", [-100.0, None])
def test_what_an_end_is_worth(penalty):
    model = make(delayed(truncates=False), planner_terminal_penalty=penalty).learn(60)
    ends = model.replay_buffer.dones[:60, 0] > 0
    model.replay_buffer.rewards[:60][ends] = 500.0  # the task is done
    source = model.make_planner_trainer().source
    at_ends = ends[source.rows.numpy()]
    assert 2 < at_ends.sum() < len(source) / 2
    np.testing.assert_array_equal(source.values[at_ends], 0.0 if penalty == -100.0 else source.values[at_ends].max())
    assert (source.values[at_ends].mean() > source.values[~at_ends].mean()) == (penalty is None)


# ---------------------------------------------------------------------------------------------------- known states


def remembering(state_history=True):
    return DelayedObservationWrapper(Drift(), UniformDelay(0, 3), receiver="independent", state_history=state_history)


@pytest.fixture(scope="module")
def trained_with_extra_states():
    return make(remembering(), planner_kwargs={"extra_state_probability": 0.5}).learn(80)


def test_known_states_reach_the_planner_and_change_the_plan(trained_with_extra_states, monkeypatch):
    model, batch, seen = trained_with_extra_states, observe(11, remembering()), []
    younger = np.arange(3, 0, -1) <= batch["delay"]  # rows of states younger than the observation
    has_extra = (batch["state_known"].astype(bool) & younger).any(1)
    assert has_extra.any() and not has_extra.all()
    plan = model.policy.planner.plan
    monkeypatch.setattr(
        model.policy.planner, "plan", lambda *args, **kwargs: seen.append((args, kwargs)) or plan(*args, **kwargs)
    )
    answer(model, batch, deterministic=False)
    args, kwargs = seen[0]
    for key in ("state_history", "state_known"):
        np.testing.assert_array_equal(kwargs[key], batch[key])
    forgetful = {key: value for key, value in kwargs.items() if key in ("value_fn", "noise")}
    forgetful["noise"] = kwargs["noise"] = th.randn(4, 6, 3, generator=th.Generator().manual_seed(0))
    plans = [plan(*args, **keywords).states for keywords in (kwargs, forgetful)]
    assert np.array_equal([not th.equal(a, b) for a, b in zip(*plans, strict=True)], has_extra)


def test_an_agent_with_extra_states_is_saved_and_repeats(trained_with_extra_states, tmp_path):
    model, batch = trained_with_extra_states, observe(11, remembering())
    model.save(tmp_path / "said")
    model.save_replay_buffer(tmp_path / "replay")
    loaded = SAID.load(tmp_path / "said", env=remembering(), device="cpu")
    loaded.warmup(2)
    expected = answer(model, batch)
    assert np.array_equal(answer(loaded, batch), expected)
    assert np.array_equal([answer(loaded, row) for row in rows_of(batch)], expected)
    loaded.load_replay_buffer(tmp_path / "replay")
    assert same_replay(loaded, model)
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 100
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        SAID.load(tmp_path / "said", env=remembering(state_history=False))


def test_the_expert_does_not_read_extra_states(trained_with_extra_states):
    sac, plain = (make(remembering(flag), cls=DelayedSAC).learn(80) for flag in (True, False))
    assert same_replay(sac, plain) and same_replay(trained_with_extra_states, plain)
    for name, value in plain.policy.state_dict().items():
        assert th.equal(sac.policy.state_dict()[name], value), name
    batch = observe(11, remembering())
    others = {**batch, "state_history": batch["state_history"] + 1.0, "state_known": 1.0 - batch["state_known"]}
    assert np.array_equal(answer(sac, batch), answer(sac, others))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("state_known", [0.0, 0.5, 1.0], "state_known runs from 0 to 1, expected 1 where"),
        ("state_known", [0.0, 2.0, 1.0], "state_known runs from 0 to 2"),
        ("state_known", [0.0, np.nan, 1.0], "state_known has entries that are NaN"),
        ("state_known", [0.0, 1.0], r"state_known has the shape \(2,\)"),
        ("state_history", np.full((3, 2), np.inf), "state_history has entries that are NaN or infinite"),
        ("state_history", np.zeros((2, 2)), r"state_history has the shape \(2, 2\)"),
        ("state_history", None, "got the keys"),
    ],
)
def test_bad_extra_states_are_refused(trained_with_extra_states, key, value, message):
    obs = rows_of(observe(5, remembering()))[4]
    obs.pop(key)
    if value is not None:
        obs[key] = np.asarray(value, np.float32)
    with pytest.raises(ValueError, match=message):
        trained_with_extra_states.predict(obs)


def test_extra_states_that_could_not_be_used_are_refused():
    with pytest.raises(ValueError, match=r"planner_kwargs=\{'extra_state_probability': 0.5\}"):
        make(remembering())
    vec_env = VecNormalize(make_vec_env(remembering, n_envs=1), norm_obs_keys=["observation"])
    with pytest.raises(ValueError, match=r"VecNormalize scales the observation .*norm_obs=False"):
        make(vec_env, planner_kwargs={"extra_state_probability": 0.5})
    vec_env = VecNormalize(make_vec_env(remembering, n_envs=1), norm_obs=False)
    make(vec_env, planner_kwargs={"extra_state_probability": 0.5})
    make(planner_kwargs={"extra_state_probability": 0.5})  # trained for later use
