"""What SAID answers: the plan of the highest value, the same for the same observation, and nothing for bad ones."""

import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_agent import answer, make, observe, rows_of, same_replay
from small_task import Drift, delayed
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_said import SAID, DelayedObservationWrapper, StableSAC
from sb3_said.delays import UniformDelay
from sb3_said.said.policies import SAIDPolicy


def test_value_is_the_smallest_critic(trained):
    policy = trained.policy
    states, actions = th.randn(3, 4, 5, 2), th.rand(3, 4, 5, 1) * 2 - 1
    critics = policy.critic({"undelayed_observation": states.reshape(-1, 2)}, actions.reshape(-1, 1))
    expected = th.minimum(*critics).reshape(3, 4, 5) * policy.return_scale.value  # in units of rewards
    assert not th.equal(critics[0], critics[1])
    th.testing.assert_close(policy.value(states, actions), expected)


class ReadingBack(TorchDispatchMode):
    """Fails where a number of a tensor is read in Python: on a GPU that waits, and no CUDA graph can be recorded."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert "_local_scalar_dense" not in str(func), "a number is read back"
        return func(*args, **(kwargs or {}))


def test_no_number_is_read_back_where_candidates_are_scored(trained):
    states, actions = th.randn(3, 4, 5, 2), th.rand(3, 4, 5, 1) * 2 - 1
    with ReadingBack():
        values = trained.policy.value(states, actions)
    assert th.equal(values, trained.policy.value(states, actions)) and trained.policy.return_scale.value != 1
    with pytest.raises(AssertionError, match="read back"), ReadingBack():
        float(values.detach()[0, 0, 0])


class Scaled(FlattenExtractor):
    """Computes otherwise in training mode than in use."""

    def __init__(self, observation_space, layer):
        super().__init__(observation_space)
        self.layer = layer(2) if layer is th.nn.BatchNorm1d else layer(0.5)

    def forward(self, observations):
        return self.layer(super().forward(observations))


@pytest.mark.parametrize("layer", [th.nn.BatchNorm1d, th.nn.Dropout])
def test_values_are_those_of_critics_in_use(layer):
    """A planner's windows end in a batch of one value, which BatchNorm cannot train on."""
    extractor = {"features_extractor_class": Scaled, "features_extractor_kwargs": {"layer": layer}}
    model = make(Drift(length=1000), policy_kwargs={"net_arch": [32], **extractor}).learn(25)
    assert model.policy.planner_is_trained
    states, actions = th.randn(3, 4, 2), th.zeros(3, 4, 1)
    model.policy.set_training_mode(True)
    batch = model.policy.value(states, actions)
    model.policy.set_training_mode(True)
    rows = [model.policy.value(states[i : i + 1, :1], actions[i : i + 1, :1])[0] for i in range(3)]
    th.testing.assert_close(batch[:, :1], th.stack(rows))


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
    scores = (
        th.minimum(
            *(
                th.stack(
                    [policy.critic({"undelayed_observation": s}, a)[i][:, 0] for s, a in zip(*futures, strict=True)]
                )
                for i in (0, 1)
            )
        ).mean(1)
        * policy.return_scale.value
    )
    th.testing.assert_close(plan.values[0], scores)
    chosen = plan.actions[0, scores.argmax(), delay].numpy()
    np.testing.assert_allclose(answer(trained, obs), 2.0 * chosen, rtol=1e-6, atol=1e-6)  # actions run from -2 to 2


def test_at_temperature_0_nothing_is_drawn_and_no_critic_asked(saved, monkeypatch):
    model, batch = SAID.load(saved, device="cpu"), observe()
    model.set_planner(temperature=0.0)
    monkeypatch.setattr(model.policy, "value", None)
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
    owner, method = (trained.policy, "_plan") if who == "planner" else (trained.policy.averaged_actor, "forward")
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
def test_bad_observations_are_refused_before_planning(trained, deterministic, monkeypatch):
    monkeypatch.setattr(trained.policy.planner, "plan", lambda *_, **__: pytest.fail("the planner was asked"))
    obs = rows_of(observe())[3] | {"observation": np.array([np.nan, 0.0], np.float32)}  # others: test_observations
    with pytest.raises(ValueError, match="observation has entries that are NaN"):
        trained.predict(obs, deterministic=deterministic)


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("temperature", [0.0, 0.5])
@pytest.mark.parametrize("who", ["planner", "expert"])
def test_what_no_network_can_answer_is_refused(saved, who, temperature, deterministic):
    model, batch = SAID.load(saved, device="cpu"), observe()
    model.set_planner(temperature=temperature)
    batch["observation"][3] = 1e30
    with model.policy.answering(who):
        if who == "expert":  # it cuts z-scored states at 10, and its tanh saturates
            assert np.abs(answer(model, batch, deterministic)).max() <= 2.0
        else:
            with pytest.raises(ValueError, match=r"1e\+30"):
                answer(model, batch, deterministic)


@pytest.mark.parametrize("who", ["planner", "expert"])
def test_no_action_of_broken_networks_is_returned(saved, who):
    model, batch = SAID.load(saved, device="cpu"), observe()
    model.set_planner(temperature=0.0)
    network = model.policy.planner.network if who == "planner" else model.policy.averaged_actor
    for parameter in network.parameters():
        parameter.data.fill_(np.nan)
    with model.policy.answering(who):
        for ask in (model, model.policy):
            with pytest.raises(ValueError, match=r"not finite|invalid values"):
                answer(ask, batch)


@pytest.mark.parametrize("who", ["planner", "expert"])
def test_every_action_is_in_the_action_space(who):
    """Scaling from [-1, 1] to uneven bounds rounds, here to beyond the upper one."""

    class Uneven(Drift):
        action_space = spaces.Box(-0.65, 0.46, (1,), np.float32)

    env = DelayedObservationWrapper(Uneven(), 2)
    model = make(env, planner_kwargs={"temperature": 0.0})
    assert model.policy.unscale_action(np.ones(1, np.float32)) > np.float32(0.46)  # the rounding that this is about
    model.policy.planner_updates.fill_(1)
    model.policy.planner.normalizer.action_mean.fill_(5.0)  # saturates
    model.policy.averaged_actor.mu.bias.data.fill_(50.0)
    with model.policy.answering(who):
        (action,) = answer(model, observe(1, env))
    assert action > 0.45 and model.action_space.contains(action)


def test_a_zeros_sign_changes_no_answer(saved):
    model = SAID.load(saved, device="cpu")
    model.set_planner(temperature=1.0)
    obs = rows_of(observe())[0]  # nothing sent yet: zeros
    negative = {key: np.where(value == 0, np.float32(-0.0), value) for key, value in obs.items()}
    assert any(np.signbit(value).any() and not value.any() for value in negative.values())
    assert np.array_equal(answer(model, negative), answer(model, obs))


def test_a_planner_for_one_age_refuses_others():
    model = make(planner_kwargs={"mask": "fixed", "temperature": 0.0}).learn(25)
    batch = observe()
    assert batch["delay"][:3, 0].tolist() == [0, 1, 2]
    answers = answer(model, batch)
    batch["delay"][:2] = 2  # s_0 and zeros stand for what was before
    assert np.array_equal(answer(model, batch), answers)
    fresher = observe(env=delayed(1, max_delay=2))
    with pytest.raises(ValueError, match=r"mask='fixed' plans at age 2 only, got 1.*mask='random'"):
        model.predict(fresher)
    with model.policy.answering("expert"):
        assert answer(model, fresher).shape == (7, 1)


def test_a_warmup_changes_no_answer(saved):
    model, other, obs = SAID.load(saved, device="cpu"), SAID.load(saved, device="cpu"), observe()
    set_random_seed(0)
    model.warmup(7)
    answers = [answer(model, obs), answer(model, obs, deterministic=False)]
    set_random_seed(0)
    assert np.array_equal(answers, [answer(other, obs), answer(other, obs, deterministic=False)])
    with pytest.raises(ValueError, match="batch_size is 0, expected at least 1"):
        model.warmup(0)


def test_a_planner_of_one_age_needs_to_know_those_that_the_expert_does_not_answer(tmp_path):
    env = delayed(delay=(0, 2))
    with pytest.warns(UserWarning, match="mask='fixed' plans at age 2 only"):
        model = make(env, planner_kwargs={"mask": "fixed"}).learn(25)
    model.set_answer("both", expert_up_to=1)
    model.set_env(env)
    model.save(tmp_path / "agent.zip")
    assert SAID.load(tmp_path / "agent.zip", env=env, device="cpu").policy.who_answers == "both"
    model.set_answer("both", expert_up_to=0)
    with pytest.raises(ValueError, match="plans at age 2 only, got 1, 2"):
        model.set_env(env)


@pytest.mark.parametrize("planner_kwargs", [{}, {"mask": "fixed"}])
def test_every_agent_can_be_warmed_up(planner_kwargs):
    for model in (make(planner_kwargs=planner_kwargs), make("Pendulum-v1", planner_kwargs=planner_kwargs)):
        model.warmup()  # the expert answers
        model.policy.planner_updates.fill_(1)
        model.warmup(2)


@pytest.mark.parametrize("ages", [{"expert_from": 2}, {"expert_up_to": 0}])
def test_where_both_answer_both_are_warmed_up(ages, monkeypatch):
    model, called = make(), []
    model.policy.planner_updates.fill_(1)
    model.policy.set_answer("both", **ages)
    decide = model.policy._decide

    def noted(observation, is_experts, deterministic):
        called.append((is_experts, int(observation["delay"].max())))
        return decide(observation, is_experts, deterministic)

    monkeypatch.setattr(model.policy, "_decide", noted)
    model.warmup()
    assert set(called) == {(True, 0), (True, 2), (False, 0), (False, 2)}
    assert model.policy.who_answers == "both"


def test_a_policy_that_is_saved_while_another_answers_keeps_that(saved, tmp_path):
    model = SAID.load(saved, device="cpu")
    model.set_answer("planner")
    with model.policy.answering("expert"):
        model.policy.save(tmp_path / "policy")
    assert SAIDPolicy.load(tmp_path / "policy").who_answers == "expert" and model.policy.who_answers == "planner"


# ---------------------------------------------------------------------------------------------------- known states


def remembering(state_history=True):
    return DelayedObservationWrapper(Drift(), UniformDelay(0, 3), receiver="independent", state_history=state_history)


@pytest.fixture(scope="module")
def trained_with_extra_states():
    return make(remembering(), planner_kwargs={"extra_state_probability": 0.5}).learn(30)


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


def test_known_states_reach_the_guess_that_the_actor_decides_on(trained_with_extra_states):
    model, batch = trained_with_extra_states, observe(11, remembering())
    has_extra = (batch["state_known"].astype(bool) & (np.arange(3, 0, -1) <= batch["delay"])).any(1)
    blind = {**batch, "state_history": 0 * batch["state_history"], "state_known": 0 * batch["state_known"]}
    seen, unseen = (model.policy._as_if_seen(model.policy.obs_to_tensor(each)[0]) for each in (batch, blind))
    moved = ~th.isclose(seen["observation"], unseen["observation"], rtol=0, atol=0).all(1)
    assert np.array_equal(moved, has_extra)
    newest = batch["state_known"][:, -1].astype(bool) & (batch["delay"][:, 0] > 0)  # s_t itself
    np.testing.assert_array_equal(seen["observation"][newest], batch["state_history"][newest, -1])


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
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        SAID.load(tmp_path / "said", env=remembering(state_history=False))


def test_the_expert_does_not_read_extra_states(trained_with_extra_states):
    sac, plain = (make(remembering(flag), cls=StableSAC).learn(30) for flag in (True, False))
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
    rewards_only = VecNormalize(make_vec_env(remembering, n_envs=1), norm_obs=False)
    model = make(rewards_only, planner_kwargs={"extra_state_probability": 0.5})
    with pytest.raises(ValueError, match=r"VecNormalize scales the observation .*norm_obs=False"):
        model.set_env(vec_env)
    assert model.env is rewards_only
    make(planner_kwargs={"extra_state_probability": 0.5})  # trained for later use


def test_a_plan_begins_with_the_answer_and_goes_on_as_the_chosen_candidate(trained):
    obs = observe()
    plans = trained.predict_plan(obs, deterministic=True)
    assert plans.shape == (7, 3, 1) and np.all(np.abs(plans) <= 2)
    np.testing.assert_array_equal(plans[:, 0], answer(trained, obs))
    for row, planned in zip(rows_of(obs), plans, strict=True):
        d = int(row["delay"][0])
        tensors = {key: th.as_tensor(value)[None] for key, value in row.items()}
        plan = trained.policy._plan(tensors, repeats=True)
        best = int(plan.values.argmax())
        assert plan.actions.shape[1] == 4
        np.testing.assert_allclose(planned, 2 * plan.actions[0, best, d : d + 3].numpy(), rtol=1e-5, atol=1e-6)
    set_random_seed(0)
    first = trained.predict_plan(obs)
    assert not np.array_equal(first, trained.predict_plan(obs))  # drawn anew
    with trained.policy.answering("expert"):
        np.testing.assert_array_equal(trained.predict_plan(obs, deterministic=True)[:, 0], answer(trained, obs))


def test_a_plan_of_weighed_candidates_is_their_mean_throughout(trained):
    before = trained.planner_kwargs["choice_factor"]
    try:
        trained.set_planner(choice_factor=1e-6)  # all alike
        obs = {key: value[2:3] for key, value in observe().items()}
        plan = trained.policy._plan({key: th.as_tensor(value) for key, value in obs.items()}, repeats=True)
        mean = 2 * plan.actions[0, :, 2:5].mean(0).numpy()
        np.testing.assert_allclose(trained.predict_plan(obs, deterministic=True)[0], mean, rtol=1e-4, atol=1e-5)
    finally:
        trained.set_planner(choice_factor=before)


def test_a_plan_that_is_not_finite_is_refused(trained, monkeypatch):
    monkeypatch.setattr(trained.policy, "unscale_action", lambda actions: actions * np.nan)
    with pytest.raises(ValueError, match="The action is not finite"):
        trained.predict_plan(observe(), deterministic=True)


def test_of_both_the_expert_answers_young_observations_and_the_planner_old_ones(saved):
    """Until an observation arrives that an action has led to, the age still grows, and the planner answers, too."""
    model = SAID.load(saved, device="cpu")
    parts = [observe(env=delayed(delay=delay, max_delay=2)) for delay in (1, 2)]
    obs = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    np.testing.assert_array_equal(obs["delay"][:, 0], [0, 1, 1, 1, 1, 1, 1, 0, 1, 2, 2, 2, 2, 2])
    young = np.array([0, 0, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0], bool)  # and not s_0
    assert not model.policy.expert_ages
    answers = {}
    for who in ("planner", "expert"):
        with model.policy.answering(who):
            answers[who] = answer(model, obs), model.predict_plan(obs, deterministic=True)
            np.testing.assert_array_equal(model.predict_plan(rows_of(obs)[0], deterministic=True), answers[who][1][:1])
    model.set_answer("both", expert_up_to=1)
    assert model.policy.who_answers == "both"
    expected = np.where(young[:, None], answers["expert"][0], answers["planner"][0])
    np.testing.assert_array_equal(answer(model, obs), expected)
    np.testing.assert_array_equal([answer(model, row) for row in rows_of(obs)], expected)
    plan = answers["planner"][1].copy()
    plan[:, 0] = expected
    np.testing.assert_array_equal(model.predict_plan(obs, deterministic=True), plan)
    with model.policy.answering("planner"):
        np.testing.assert_array_equal(answer(model, obs), answers["planner"][0])
    set_random_seed(0)
    first = answer(model, obs, deterministic=False)
    set_random_seed(0)
    np.testing.assert_array_equal(answer(model, obs, deterministic=False), first)
    assert not np.array_equal(first, expected)
    # The other way round the expert has the oldest ages, and begins
    model.set_answer("both", expert_from=2)
    old = np.array([1, 1, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1], bool)
    np.testing.assert_array_equal(
        answer(model, obs), np.where(old[:, None], answers["expert"][0], answers["planner"][0])
    )


def test_an_action_of_zero_amid_an_episode_is_not_taken_for_its_start(saved):
    model = SAID.load(saved, device="cpu")
    one = {key: part[:1] for key, part in observe().items()} | {"delay": np.zeros((1, 1), np.float32)}
    model.set_answer("both", expert_up_to=0)  # so that the planner begins
    for history, who in (([0.0, 0.0], "planner"), ([0.5, 0.0], "expert"), ([0.0, 0.5], "expert")):
        obs = one | {"action_history": np.array(history, np.float32).reshape(1, 2, 1)}
        with model.policy.answering(who):
            expected = answer(model, obs)
        np.testing.assert_array_equal(answer(model, obs), expected)


@pytest.mark.parametrize("how", [{"temperature": 0.0}, {"temperature": 1.0, "choice_factor": 1.0}])
def test_rows_that_are_answered_at_once_are_answered_as_each_alone(saved, how):
    model, obs = SAID.load(saved, device="cpu"), observe()
    model.set_planner(**how)
    expected = answer(model, obs)
    for who in ("planner", "both"):
        if who == "both":
            model.set_answer("both", expert_up_to=0)
            expected = answer(model, obs)
        with model.policy.answering(who, at_once=True):
            np.testing.assert_allclose(answer(model, obs), expected, rtol=1e-4, atol=1e-5)


def test_the_actor_decides_on_the_guessed_present_as_if_it_saw_it(saved, tmp_path):
    model, obs = SAID.load(saved, device="cpu"), observe()
    model.set_planner(decided_by="actor")
    state, history, delay = (th.as_tensor(obs[key]) for key in ("observation", "action_history", "delay"))
    guessed = model.policy.planner.guess(state, history, delay[:, 0].long())[0].numpy()
    assert not np.allclose(guessed[2:], obs["observation"][2:]) and obs["delay"].max() == 2
    with model.policy.answering("expert"):
        expected = answer(model, {**obs, "observation": guessed, "delay": np.zeros_like(obs["delay"])})
        assert not np.allclose(expected[1:], answer(model, obs)[1:])
    np.testing.assert_allclose(answer(model, obs), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal([answer(model, row) for row in rows_of(obs)], answer(model, obs))
    with model.policy.answering("planner", at_once=True):
        np.testing.assert_allclose(answer(model, obs), expected, rtol=1e-5, atol=1e-6)
    plans = model.predict_plan(obs, deterministic=True)
    np.testing.assert_array_equal(plans[:, 0], answer(model, obs))
    model.save(tmp_path / "actor.zip")
    np.testing.assert_array_equal(answer(SAID.load(tmp_path / "actor.zip", device="cpu"), obs), answer(model, obs))
    with pytest.warns(UserWarning, match="learned at ages 2 and is given 0"):  # by the guess
        model.check_ages([2])
    model.set_planner(decided_by="plan")
    np.testing.assert_array_equal(model.predict_plan(obs, deterministic=True)[:, 1:], plans[:, 1:])
    assert not np.allclose(answer(model, obs), plans[:, 0])


def test_a_warning_of_ages_that_were_not_met_points_at_the_call(saved):
    model, obs = SAID.load(saved, device="cpu"), observe()
    model.set_answer("expert")
    model.trained_ages = [0]
    with pytest.warns(UserWarning, match="learned at ages 0 and is given") as caught:
        model.predict(obs)
    with pytest.warns(UserWarning, match="learned at ages 0 and is given") as of_env:
        model.set_env(make().get_env())
    assert {warning.filename for warning in (*caught, *of_env)} == {__file__}


def test_no_actor_that_has_not_learned_decides():
    with pytest.raises(ValueError, match="decided_by='actor' lets the expert's actor decide, which this agent has not"):
        make().set_planner(decided_by="actor")


def test_where_no_expert_has_learned_its_actor_does_not_decide(tmp_path):
    model = make(learning_starts=100, planner_kwargs={"decided_by": "actor"})
    with pytest.warns(UserWarning, match="No expert has learned whose actor could decide"):
        model.learn(25)
    model.save(tmp_path / "agent.zip")
    loaded, obs = SAID.load(tmp_path / "agent.zip", device="cpu"), observe()
    assert loaded.policy.planner.config.decided_by == "plan"
    np.testing.assert_array_equal(answer(loaded, obs), answer(model, obs))


def test_without_delay_there_are_no_ages_to_share():
    model = make(Drift())
    model.learn(25)
    with pytest.raises(ValueError, match="Without delay there is no age but 0"):
        model.set_answer("both", expert_up_to=0)


def test_both_need_an_age_and_keep_what_each_has_met(saved, tmp_path):
    model = SAID.load(saved, device="cpu")
    max_delay = model.policy.max_delay
    wrong = [{}, {"expert_up_to": 0, "expert_from": 1}]
    wrong += [{"expert_up_to": age} for age in (-2, -1, 0.5, max_delay - 0.5, max_delay, max_delay + 2)]
    wrong += [{"expert_from": age} for age in (-1, 0, 0.5, 1.5, max_delay + 1, max_delay + 2)]
    for ages in wrong:
        with pytest.raises(ValueError, match=r"expert_up_to is .* and expert_from .* expected one of them"):
            model.set_answer("both", **ages)
    with pytest.raises(
        ValueError, match=r"expert_up_to=1 and expert_from=None need set_answer\('both'\), got 'planner'"
    ):
        model.set_answer("planner", expert_up_to=1)
    with pytest.raises(ValueError, match="Up to which age"), model.policy.answering("both"):
        pass
    model.trained_ages = [max_delay]
    for up_to in range(max_delay):
        model.set_answer("both", expert_up_to=up_to)
        model.save(tmp_path / "agent.zip")
        loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
        assert loaded.policy.expert_ages == range(up_to + 1) and loaded.policy.who_answers == "both"
        with pytest.warns(UserWarning, match="has not met"):
            model.check_ages([up_to, max_delay])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.check_ages([max_delay])
    with pytest.raises(ValueError, match="not trained yet"):
        make().set_answer("both", expert_up_to=0)


def test_every_age_at_which_the_expert_answers_comes_back_from_its_part():
    policy = make(delayed((0, 40))).policy
    policy.planner_updates.fill_(1.0)
    for age in range(40):
        policy.set_answer("both", expert_up_to=age)
        assert policy.expert_ages == range(age + 1)
        policy.set_answer("both", expert_from=age + 1)
        assert policy.expert_ages == range(age + 1, 41)


@pytest.mark.parametrize("how", ["actor", "both"])
def test_a_plan_whose_first_action_is_the_actor_s_own(how):
    """Without an average, whose weights would take no gradient."""
    model, obs = make(delayed((0, 2)), actor_averaging=0.0).learn(25), observe()
    if how == "actor":
        model.set_planner(decided_by="actor")
    else:
        model.set_answer("both", expert_up_to=1)
    plan = model.predict_plan(obs, deterministic=True)
    np.testing.assert_allclose(plan[:, 0], answer(model, obs), rtol=1e-5, atol=1e-6)
