"""SAID from logs: no environment, values of its own, and the same files, callbacks and resumes as online."""

import warnings
from contextlib import nullcontext
from dataclasses import asdict, replace

import numpy as np
import pytest
import small_agent
import torch as th
from small_agent import PLANNER, answer, observe
from small_task import delayed
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, PlannerConfig, StableSAC
from sb3_said.files.archive import SavedFileError, load_tree, save_tree
from sb3_said.offline import IQL, Dataset, IQLConfig, load_dataset
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.said.policies import SAIDPolicy
from sb3_said.said.training import PlannerTraining
from sb3_said.said.ways import WAYS


def log(n_episodes=6, length=12, seed=0):
    """Return episodes of the small task under random actions; the state steers the reward."""
    rng = np.random.default_rng(seed)
    states, actions = np.zeros((n_episodes, length + 1, 2), np.float32), np.zeros((n_episodes, length, 1), np.float32)
    states[:, 0] = rng.normal(size=(n_episodes, 2))
    for t in range(length):
        actions[:, t] = rng.uniform(-1, 1, (n_episodes, 1))
        states[:, t + 1] = 0.9 * states[:, t] + 0.1 * np.stack([2 * actions[:, t, 0], states[:, t, 0]], axis=1)
    ends = np.zeros((n_episodes, length), bool)
    ends[:, -1] = True
    rewards = -np.abs(states[:, :-1, 0]).ravel()
    flat = states[:, :-1].reshape(-1, 2), actions.reshape(-1, 1)
    return Dataset(*flat, rewards, np.zeros(ends.size, bool), ends.ravel(), states[:, -1])


def make(env=None, **kwargs):
    """Return an agent whose V is as small as its other networks."""
    return small_agent.make(env, **{"iql_kwargs": {"hidden": 16}, **kwargs})


def learn(model=None, steps=5, **kwargs):
    model = make() if model is None else model
    return model.learn_offline(log(), steps, **kwargs)


def weights(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items() if name != "planner_updates"}


@pytest.fixture(scope="module")
def learned():
    model = make()
    model.env.envs[0].step = model.env.envs[0].reset = None  # neither is called
    return learn(model)


def test_the_planner_answers_after_learning_from_logs(learned, tmp_path):
    assert learned.policy.who_answers == "planner" and learned.policy.planner_updates == 5
    assert learned._n_updates == 0  # no expert
    learned.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    obs = observe()
    np.testing.assert_array_equal(answer(loaded, obs), answer(learned, obs))
    states = th.randn(5, 2)
    with th.no_grad():
        assert th.equal(loaded.policy.value(states, None), learned.policy.value(states, None))
    assert loaded.value == "iql"


def test_v_is_learned_as_told_and_a_file_keeps_how(tmp_path):
    given = {"expectile": 0.9, "hidden": 16, "updates": 3}
    model = make(iql_kwargs=given)
    assert model.policy.values is None  # online the critics score
    steps, step = [], IQL.step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(IQL, "step", lambda iql: steps.append(iql.values.config) or step(iql))
        learn(model, steps=2)
    assert steps == [IQLConfig(**given)] * 6 and model.policy.values.config == steps[0]
    model.save(tmp_path / "agent.zip")
    model.policy.save(tmp_path / "policy.zip")
    loaded = SAID.load(tmp_path / "agent.zip", env=model.env, device="cpu")
    alone = SAIDPolicy.load(tmp_path / "policy.zip", device="cpu")
    assert loaded.iql_kwargs == model.iql_kwargs == asdict(steps[0])
    for policy in (loaded.policy, alone):
        assert policy.values.config == steps[0]
        th.testing.assert_close(policy.values.state_dict(), model.policy.values.state_dict(), rtol=0, atol=0)
    assert learn(loaded, steps=1).policy.values.config == steps[0]  # it learns on as before


def test_a_number_of_updates_may_be_written_as_a_float():
    assert make().learn_offline(log(), 2.0).policy.planner_updates == 2
    with pytest.raises(ValueError, match=r"gradient_steps must be a whole number, at least 1, got 2\.5"):
        make().learn_offline(None, 2.5)


def test_another_training_on_a_log_is_not_taken_for_one_on_random_actions():
    model = make().learn_offline(log(), 3)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The planner imitates random")
        model.train_planner()
    assert model.policy.planner_updates > 0


def test_no_other_settings_of_v_are_taken():
    with pytest.raises(ValueError, match=r"IQL has no setting tau; it has expectile, hidden, .*updates"):
        make(iql_kwargs={"tau": 0.9})
    with pytest.raises(ValueError, match=r"expectile is 0\.3, expected"):
        make(iql_kwargs={"expectile": 0.3})


def test_all_of_a_log_is_learned_from_and_then_the_newest_part_of_its_own_steps_again():
    model = learn(make(planner_newest_fraction=0.2, learning_starts=50), steps=1)
    assert len(model.make_planner_trainer(1).source) > 0.9 * len(log())
    with pytest.warns(UserWarning, match="no longer holds the dataset"):
        model.learn(60)
    assert 0.9 * 12 < len(model.make_planner_trainer(1).source) <= 12


def test_a_guess_learns_many_steps_at_once_from_its_own_steps_and_single_ones_from_a_log():
    model = learn(steps=1)
    assert model.make_planner_trainer(1).guess_steps == 1
    with pytest.warns(UserWarning, match="no longer holds the dataset"):
        model.learn(25)
    assert model.make_planner_trainer(1).guess_steps == model.policy.max_delay > 1


def test_candidates_are_scored_by_v_alone(learned, monkeypatch):
    monkeypatch.setattr(type(learned.policy), "q_value", lambda *_: pytest.fail("asked the critics"))
    obs, before = observe(), answer(learned, observe())
    with th.no_grad():  # a V that likes the other end of states chooses other candidates
        learned.policy.values.v[-1].weight.neg_()
        flipped = answer(learned, obs)
        learned.policy.values.v[-1].weight.neg_()
    assert not np.array_equal(before, flipped)
    np.testing.assert_array_equal(answer(learned, obs), before)


def test_v_chooses_where_the_settings_are_the_defaults():
    """They score the decision at a present that all candidates share, where no action shows in V."""
    model = learn(make(planner_kwargs={"scored_states": PlannerConfig().scored_states}))
    assert model.policy.planner.config.scored_states == "future"
    obs = {key: th.as_tensor(value) for key, value in observe().items()}
    assert (model.policy._plan(obs).values.std(1) > 0).all()
    with pytest.raises(ValueError, match="use 'future' or 'all'"):
        model.set_planner(scored_states="decision")


def test_a_log_that_cannot_be_read_leaves_a_trained_agent_as_it_was(tmp_path):
    model = make().learn(25)
    before, obs = weights(model), observe()
    with pytest.raises(ValueError):
        model.learn_offline(replace(log(), rewards=np.full(72, np.nan, np.float32)), 3)
    assert (model.value, model.planner_newest_fraction, model.policy.values) == ("critics", 1.0, None)
    th.testing.assert_close(weights(model), before, rtol=0, atol=0)
    assert np.isfinite(answer(model, obs)).all()


@pytest.mark.parametrize("how", ["refused", "stopped"])
def test_a_training_that_does_not_begin_leaves_a_trained_agent_as_it_was(how, tmp_path):
    model, obs = make(planner_kwargs={"temperature": 1.0}).learn(25), observe()
    replay, before, own = model.replay_buffer, weights(model), answer(model, obs)
    if how == "refused":
        learn(steps=4, folder=tmp_path, save_interval=2)
        with pytest.raises(SavedFileError, match="other data"):
            model.learn_offline(log(seed=1), 4, folder=tmp_path)
    else:
        with pytest.raises(KeyboardInterrupt):
            model.learn_offline(log(), 4, should_stop=lambda: True)
    assert (model.value, model.planner_newest_fraction, model.policy.values) == ("critics", 1.0, None)
    assert model.replay_buffer is replay and model.num_timesteps == 25
    th.testing.assert_close(weights(model), before, rtol=0, atol=0)
    np.testing.assert_array_equal(answer(model, obs), own)


def test_a_training_that_does_not_begin_leaves_the_scale_of_observations_too():
    env = VecNormalize(DummyVecEnv([delayed]), norm_obs_keys=["observation"])
    model = make(env).learn(25)
    before = [rms.copy() for rms in (env.obs_rms["observation"], env.ret_rms)]
    with pytest.raises(KeyboardInterrupt):
        model.learn_offline(log(), 4, should_stop=lambda: True)
    for rms, own in zip((env.obs_rms["observation"], env.ret_rms), before, strict=True):
        np.testing.assert_array_equal([rms.mean, rms.var], [own.mean, own.var])
        assert rms.count == own.count
    model.learn_offline(log(), 4)
    assert env.obs_rms["observation"].count > before[0].count


@pytest.mark.parametrize("n_envs", [1, 2])
def test_after_logs_it_learns_online_from_steps_of_its_own(n_envs):
    model = learn(make(DummyVecEnv([delayed] * n_envs)))
    with pytest.warns(UserWarning, match="its replay no longer holds the dataset"):
        model.learn(30)
    assert model.replay_buffer.size() * n_envs == 30 and model.replay_buffer.buffer_size == 500 // n_envs
    assert model.learn(10, reset_num_timesteps=False).replay_buffer.size() * n_envs == 40


def test_a_replay_of_logs_is_known_as_such_from_its_file_too(tmp_path):
    model = learn(make(planner_newest_fraction=0.2), steps=2)
    model.save(tmp_path / "agent")
    model.save_replay_buffer(tmp_path / "replay")
    loaded = SAID.load(tmp_path / "agent", env=delayed(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay")
    assert len(loaded.make_planner_trainer(1).source) > 0.9 * len(log())
    with pytest.warns(UserWarning, match="no longer holds the dataset"):
        loaded.learn(25, reset_num_timesteps=False)
    assert loaded.num_timesteps == loaded.replay_buffer.size() == 25


@pytest.mark.parametrize("n_steps", [30, 80])  # fewer than the log has, and more
def test_a_replay_of_own_steps_takes_the_place_of_logs_at_its_own_size(n_steps, tmp_path):
    make(learning_starts=100, planner_gradient_steps=1).learn(n_steps).save_replay_buffer(tmp_path / "replay")
    model = learn(steps=2)
    model.load_replay_buffer(tmp_path / "replay")
    replay = model.replay_buffer
    assert (replay.size(), replay.buffer_size, replay.holds_logs) == (n_steps, model.buffer_size, False)


def test_what_learns_from_its_own_steps_alone_takes_no_logs(tmp_path):
    learn(steps=2).save_replay_buffer(tmp_path / "replay")
    with pytest.raises(SavedFileError, match="holds logs, from which StableSAC does not learn; SAID, BC and DQL do"):
        small_agent.make(cls=StableSAC).load_replay_buffer(tmp_path / "replay")


def test_steps_of_an_agent_that_was_saved_before_its_first_update_count(tmp_path):
    """Those of logs are updates, and do not."""
    for model, n_steps in ((make(learning_starts=100).learn(10), 10), (learn(steps=2), 0)):
        model.save(tmp_path / "agent")
        loaded = SAID.load(tmp_path / "agent", env=delayed(), device="cpu")
        assert loaded.learn(5, reset_num_timesteps=False).num_timesteps == n_steps + 5


def test_an_expert_that_has_learned_nothing_is_not_let_answer():
    model = learn()
    for kwargs in ({"who": "expert"}, {"who": "both", "expert_up_to": 1}):
        with pytest.raises(ValueError, match="The expert has learned nothing"):
            model.set_answer(**kwargs)
    assert model.policy.who_answers == "planner"


@pytest.mark.parametrize("before", ["expert", "student", "actor"])
def test_the_planner_of_the_logs_answers_whoever_did_before(before):
    """And callbacks meet it, as EvalCallback that keeps the best agent."""
    model = make().learn(25)
    if before == "student":
        model.distill(n_labels=20, own_steps=5, rounds=1, gradient_steps=2)
    if before == "actor":
        model.set_planner(decided_by="actor")
    else:
        model.set_answer(before)
    met = []

    def note(*_):
        met.append((model.policy.who_answers, model.policy.planner.config.decided_by))
        return True

    learn(model, callback=note)
    note()
    assert {*met} == {("planner", "plan")} and len(met) == 6


def test_an_actor_that_has_learned_nothing_is_not_let_decide(learned, tmp_path):
    message = "the expert's actor decide, which this agent has not trained"
    with pytest.raises(ValueError, match=message):
        learn(make(planner_kwargs={"decided_by": "actor"}))
    learned.save(tmp_path / "agent.zip")
    with pytest.raises(ValueError, match=message):
        SAID.load(tmp_path / "agent.zip", device="cpu", planner_kwargs={"decided_by": "actor"})
    supplied = {"planner_kwargs": {**learned.planner_kwargs, "decided_by": "actor"}}
    with pytest.raises(ValueError, match=message):
        SAID.load(tmp_path / "agent.zip", device="cpu", custom_objects=supplied)
    make().save(tmp_path / "new.zip")  # whose expert may still learn
    loaded = SAID.load(tmp_path / "new.zip", env=delayed(), device="cpu", planner_kwargs={"decided_by": "actor"})
    assert loaded.learn(25).policy.planner.config.decided_by == "actor"


@pytest.mark.parametrize("is_loaded", [False, True])
def test_steps_that_follow_updates_are_counted_from_the_first(is_loaded, tmp_path):
    """Else states would be scaled by the first one, and no step be taken at random."""
    model = learn(steps=3)
    if is_loaded:
        model.save(tmp_path / "agent.zip")
        model = SAID.load(tmp_path / "agent.zip", env=delayed(), device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(25, reset_num_timesteps=False)
    assert model.num_timesteps == 25 and model._n_updates == 25 - 20  # learning_starts
    normalizer = model.policy.state_normalizer
    assert normalizer.fitted_at > 20 and (normalizer.deviation > 0.1).all()
    learn(model, steps=3)  # once more, by one that has an expert now
    with pytest.warns(UserWarning, match="no longer holds the dataset"):
        model.learn(22, reset_num_timesteps=False)
    assert model.num_timesteps == 22 and model._n_updates == 5 + 2


def test_other_logs_are_not_gone_on_with(tmp_path):
    learn(steps=4, folder=tmp_path, save_interval=2)
    with pytest.raises(SavedFileError, match="other data; give the same logs, or another folder"):
        make().learn_offline(log(seed=1), 4, folder=tmp_path, save_interval=2)


def test_v_is_learned_online_too_and_returns_to_go_have_the_critics_values_at_cuts(monkeypatch):
    model = make(value="iql").learn(36)
    fresh = model._make_value_trainer().values.v[0].weight
    assert model.policy.values is not None and not th.equal(model.policy.values.v[0].weight, fresh)
    asked = []
    monkeypatch.setattr(model, "_stored_values", lambda states, _: asked.append(states) or th.zeros(len(states)))
    model.make_planner_trainer()
    source = model.replay_buffer.window_source(model.newest_fraction, None)
    ends = source.start_states()[(source.remaining == 1) & ~source.terminated[source.rows, source.envs]]
    assert len(ends) > 1 and th.equal(th.cat(asked), ends)
    with pytest.raises(ValueError, match="value is 'v', expected one of critics, iql"):
        make(value="v")


def test_values_read_states_as_vec_normalize_leaves_them():
    """The planner has normalised states, so V must too: its z-scores then find nothing left to scale."""
    env = VecNormalize(DummyVecEnv([lambda: delayed()]), norm_obs_keys=["observation"], norm_reward=False)
    model = make(env=env, value="iql").learn(25)
    states = model.replay_buffer.observations[:25, 0]
    normalized = env.normalize_obs({"observation": states})["observation"]
    np.testing.assert_allclose(model.policy.values.mean, normalized.mean(0), atol=1e-5)


def test_v_has_the_agents_discount_and_seed():
    values = [learn(make(gamma=gamma, seed=seed), 1)._make_value_trainer() for gamma, seed in ((0.5, 0), (0.9, 4))]
    assert [(trainer.gamma, trainer.generator.initial_seed()) for trainer in values] == [(0.5, 0), (0.9, 4)]


def test_callbacks_follow_each_update_meet_a_young_planner_and_can_end_it(monkeypatch):
    monkeypatch.setattr("sb3_said.said.learning.HAND_OVER_INTERVAL", 2)
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append((self.num_timesteps, int(self.model.policy.planner_updates)))
            return self.num_timesteps < 5

    model = learn(steps=6, callback=Watch())
    assert seen == [(1, 1), (2, 2), (3, 2), (4, 4), (5, 4)]
    assert model.num_timesteps == model.policy.planner_updates == 5


def test_callbacks_of_the_last_update_meet_the_trained_planner():
    met = []
    learn(steps=5, callback=lambda a, _: met.append(int(a["self"].policy.planner_updates)) or True)
    assert met[-4:] == [1, 1, 1, 5]


def test_a_resumed_training_ends_as_one_that_never_stopped(tmp_path):
    whole = weights(learn())

    class Stop(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 4:
                raise ConnectionAbortedError
            return True

    with pytest.raises(ConnectionAbortedError):
        learn(callback=Stop(), folder=tmp_path, save_interval=2)
    resumed = make()
    begun = []
    resumed_training = resumed.learn_offline(
        log(), 5, folder=tmp_path, save_interval=2, callback=lambda a, _: begun.append(a["self"].num_timesteps) or True
    )
    assert begun[0] == 3  # the checkpoint of update 4 was to follow its callbacks
    th.testing.assert_close(weights(resumed_training), whole, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("trained", "name"), [("trainer", "optimizer"), ("trainer", "yardstick_optimizer"), ("values", "optimizer")]
)
def test_a_checkpoint_whose_moments_have_another_size_is_refused(trained, name, tmp_path):
    """Fused optimizers do not compare sizes: they would read and write beyond what is too short."""
    learn(folder=tmp_path)
    path = tmp_path / "planner_checkpoint.zip"
    state = load_tree(path)
    state[trained][name][0]["exp_avg"] = th.zeros(1)
    save_tree(path, state)
    with pytest.raises(SavedFileError, match=r"does not fit: exp_avg is \(torch\.float32, \(1,\)\)"):
        learn(folder=tmp_path)


def test_values_that_are_not_finite_are_not_handed_over(monkeypatch):
    step = IQL.step

    def diverge(iql):
        with th.no_grad():
            iql.values.v[0].weight.fill_(th.nan)
        return step(iql)

    model, obs = make(), observe(2)
    before = answer(model, obs)
    monkeypatch.setattr(IQL, "step", diverge)
    with pytest.raises(FloatingPointError, match=r"V\(s\) are no longer finite.*lower learning_rate of iql_kwargs"):
        learn(model)
    np.testing.assert_array_equal(answer(model, obs), before)
    assert not model.policy.planner_is_trained and model.value == "critics"


def test_callbacks_of_a_resumed_training_meet_the_planner(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        learn(folder=tmp_path, save_interval=2, should_stop=lambda: (tmp_path / "planner_checkpoint.zip").exists())
    answered = []
    learn(folder=tmp_path, callback=lambda a, _: answered.append(a["self"].policy.who_answers) or True)
    assert answered[-1] == "planner" and "expert" not in answered[1:]  # but of the call before the first update


@pytest.mark.parametrize("is_asked", [False, True])
def test_a_ctrl_c_amid_an_update_ends_it_as_any_other_unless_it_came_twice(is_asked, monkeypatch):
    step, asked, ended = PlannerTrainer.step, [], []

    def interrupted(trainer):
        if trainer.n_updates == 2:
            asked.append(is_asked)
            raise KeyboardInterrupt
        step(trainer)

    class End(BaseCallback):
        def _on_step(self):
            return True

        def _on_training_end(self):
            ended.append(True)

    monkeypatch.setattr(PlannerTrainer, "step", interrupted)
    model = make()
    with pytest.raises(KeyboardInterrupt) if is_asked else nullcontext():
        learn(model, callback=End(), should_stop=lambda: any(asked))
    assert model.policy.planner_updates == 2 and ended == [True] * (not is_asked)


@pytest.mark.parametrize("is_asked", [False, True])
def test_a_training_that_ends_before_its_first_update_leaves_a_trained_agent_as_it_was(is_asked, monkeypatch):
    model, obs = make(planner_kwargs={"temperature": 1.0}).learn(25), observe()
    replay, before, own = model.replay_buffer, weights(model), answer(model, obs)
    asked = []

    def interrupted(trainer):
        asked.append(is_asked)
        raise KeyboardInterrupt

    monkeypatch.setattr(PlannerTrainer, "step", interrupted)
    with pytest.raises(KeyboardInterrupt) if is_asked else nullcontext():
        model.learn_offline(log(), 4, should_stop=lambda: any(asked))
    assert (model.value, model.policy.values, model.num_timesteps) == ("critics", None, 25)
    assert model.replay_buffer is replay and model._planner_trained_at == 25
    th.testing.assert_close(weights(model), before, rtol=0, atol=0)
    np.testing.assert_array_equal(answer(model, obs), own)


def test_a_training_that_diverges_at_once_leaves_a_trained_agent_as_it_was(tmp_path):
    make().learn(25).save(tmp_path / "agent.zip")
    wild = {**PLANNER, "learning_rate": 1e30, "warmup_steps": 0}
    model = SAID.load(tmp_path / "agent.zip", env=delayed(), planner_kwargs=wild, device="cpu")
    replay, before, own = model.replay_buffer, weights(model), answer(model, observe())
    with pytest.raises(FloatingPointError, match="Update 0"):
        model.learn_offline(log(), 101)
    assert (model.value, model.policy.values, model.num_timesteps) == ("critics", None, 25)
    assert model.replay_buffer is replay
    th.testing.assert_close(weights(model), before, rtol=0, atol=0)
    np.testing.assert_array_equal(answer(model, observe()), own)


def test_a_decision_of_the_users_own_is_kept_and_one_of_a_trial_is_not():
    model = make(delayed(delay=(0, 2)), planner_ways=WAYS).learn(25)
    own = {"temperature": 0.7, "n_candidates": 5, "sampling_steps": 3}
    model.set_planner(**own)
    learn(model)
    assert {name: getattr(model.policy.planner.config, name) for name in own} == own
    model.set_planner(**WAYS["weighed"])  # as a trial takes it
    model.train_planner()
    learn(model)
    config = model.policy.planner.config
    assert (config.temperature, config.sampling_steps, config.choice_factor) == (0.0, 5, PlannerConfig.choice_factor)
    assert config.n_candidates == 5


def test_a_failed_training_changes_nothing(monkeypatch):
    model = make(value="iql").learn(25)
    before = weights(model)
    monkeypatch.setattr(PlannerTraining, "_train_values", lambda _: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        model.train_planner()
    th.testing.assert_close(weights(model), before, rtol=0, atol=0)


def test_an_expert_of_other_steps_values_no_logs(monkeypatch):
    model = make().learn(25)
    monkeypatch.setattr(model, "_stored_values", lambda *_: pytest.fail("asked the critics"))
    learn(model)


def test_logs_are_learned_from_at_every_age():
    model = make(delayed(delay=(0, 2))).learn_offline(log(), 3)
    obs = observe(env=delayed(delay=1, max_delay=2))
    assert np.isfinite(answer(model, obs)).all()


def test_v_reads_what_follows_an_episode_as_vec_normalize_leaves_it():
    env = VecNormalize(DummyVecEnv([delayed]), norm_obs_keys=["observation"], norm_reward=False)
    model = make(env, value="iql", learning_starts=100, planner_gradient_steps=1).learn(30)
    data = load_dataset(model.replay_buffer, model.observation_space, model.action_space)
    expected = env.normalize_obs({"observation": data.next_states})["observation"]
    np.testing.assert_allclose(model._make_value_trainer().data.next_states, expected, atol=1e-5)


def test_v_begins_with_weights_of_the_agents_seed():
    kwargs = {"value": "iql", "learning_starts": 100, "planner_gradient_steps": 1}
    agents = [make(seed=seed, **kwargs).learn(10) for seed in (0, 0, 4)]
    first, again, other = (agent._make_value_trainer().values.v[0].weight for agent in agents)
    assert th.equal(first, again) and not th.equal(first, other)
