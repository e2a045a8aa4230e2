"""SAID: an expert that learns as StableSAC does, a planner that answers, and files that bring back both."""

import inspect
import warnings
import zipfile
from dataclasses import asdict, fields

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_agent import PLANNER, answer, make, observe, same_replay
from small_task import Drift, delayed
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, PlannerConfig, StableSAC
from sb3_said.delays import TotalDelay, UniformDelay
from sb3_said.files.archive import SavedFileError
from sb3_said.offline import IQLConfig

# ---------------------------------------------------------------------------------------------------- the expert


@pytest.mark.parametrize("planner_train_freq", [None, 10])
def test_the_expert_learns_and_acts_exactly_as_without_a_planner(planner_train_freq):
    said = make(planner_train_freq=planner_train_freq, learning_starts=5).learn(20)
    sac = make(cls=StableSAC, learning_starts=5).learn(20)
    assert said.policy.planner_is_trained and said._n_updates == sac._n_updates == 15
    assert same_replay(said, sac)  # collection never asked the planner
    expected = sac.policy.state_dict()
    th.testing.assert_close({key: said.policy.state_dict()[key] for key in expected}, expected, rtol=0, atol=0)
    th.testing.assert_close(said.log_ent_coef, sac.log_ent_coef, rtol=0, atol=0)


class Normalized(FlattenExtractor):
    """Normalises batches, as a user's own extractor may."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.norm = th.nn.BatchNorm1d(self.features_dim)

    def forward(self, observations):
        return self.norm(super().forward(observations))


def test_only_the_cpus_generator_is_put_back_so_no_other_is_seeded(monkeypatch):
    """Else an expert on a GPU would explore with the same noise after each training of its planner."""
    model = make(value="iql").learn(25)
    monkeypatch.setattr(th.cuda, "manual_seed_all", lambda _: pytest.fail("GPUs were seeded"))
    before = th.get_rng_state()
    model.train_planner(2)
    assert th.equal(th.get_rng_state(), before)
    model.distill(8, n_labels=20, own_steps=10, rounds=1, gradient_steps=4)


def test_batch_norm_learns_nothing_from_the_planners_training():
    kwargs = {"policy_kwargs": {"net_arch": [16], "features_extractor_class": Normalized}, "learning_starts": 5}
    said = make(Drift(), planner_train_freq=10, **kwargs).learn(17)
    sac = make(Drift(), StableSAC, **kwargs).learn(17)
    expected = sac.policy.state_dict()
    assert "critic.features_extractor.extractor.norm.running_mean" in expected
    th.testing.assert_close({key: said.policy.state_dict()[key] for key in expected}, expected, rtol=0, atol=0)


def test_the_expert_answers_until_the_planner_is_trained():
    said, obs = make(), observe()
    sac = make(cls=StableSAC)
    np.testing.assert_allclose(answer(said, obs), answer(sac, obs), rtol=1e-5)
    with pytest.raises(ValueError, match="not trained yet"), said.policy.answering("planner"):
        pass
    said.learn(25)
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


def test_callbacks_are_answered_by_the_expert_while_learning():
    evaluation, asked = EvalCallback(Monitor(delayed()), eval_freq=5, n_eval_episodes=2, verbose=0), Asked(observe())
    model = make(planner_train_freq=10, learning_starts=5).learn(20, CallbackList([evaluation, asked]))
    sac_evaluation = EvalCallback(Monitor(delayed()), eval_freq=5, n_eval_episodes=2, verbose=0)
    make(cls=StableSAC, learning_starts=5).learn(20, sac_evaluation)
    np.testing.assert_allclose(evaluation.evaluations_results, sac_evaluation.evaluations_results, rtol=1e-4)
    assert np.array_equal(asked.ours, asked.experts)
    assert not np.allclose(answer(model, asked.obs), asked.ours[-1])  # and by the planner afterwards


# ---------------------------------------------------------------------------------------------------- settings


def settings(**changes):
    """Every setting of the small planner."""
    return PlannerConfig(**PLANNER | changes).to_dict()


def test_how_the_planner_answers_can_be_changed_and_is_saved(saved, tmp_path):
    model, obs = SAID.load(saved, device="cpu"), observe()
    before = answer(model, obs)
    assert model.planner_kwargs == settings()
    model.set_planner(temperature=3.0, n_candidates=9, sampling_steps=3)
    assert not np.allclose(answer(model, obs), before)
    model.set_planner(temperature=0.3)
    changes = {"temperature": 0.3, "n_candidates": 9, "sampling_steps": 3}
    assert model.planner_kwargs == settings(**changes)
    model.save(tmp_path / "changed")
    again = SAID.load(tmp_path / "changed", env=delayed(), device="cpu")
    assert again.policy.planner.config == PlannerConfig(**PLANNER | changes)
    assert np.array_equal(answer(again, obs), answer(model, obs))
    model.set_planner(**{name: getattr(PlannerConfig(**PLANNER), name) for name in changes})
    assert np.array_equal(answer(model, obs), before)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"depth": 2}, "got depth; give it as planner_kwargs of a new agent"),
        ({"temperature": -1.0}, "temperature is -1"),
        ({"n_candidates": 0}, "n_candidates is 0"),
        ({"temprature": 0.5}, "got temprature; did you mean temperature"),
        ({"scored_states": "past"}, "scored_states"),
    ],
)
def test_settings_that_cannot_be_changed_are_refused(saved, given, message):
    model = SAID.load(saved, device="cpu")
    before = answer(model, observe())
    with pytest.raises(ValueError, match=message):
        model.set_planner(**given)
    assert model.planner_kwargs == settings() and np.array_equal(answer(model, observe()), before)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"planner_kwargs": {"dept": 2}}, "no setting dept; did you mean depth"),
        ({"planner_kwargs": {"horizon": 1}}, "horizon is 1"),
        ({"planner_gradient_steps": 0}, "planner_gradient_steps must be a whole number, at least 1, got 0"),
        ({"planner_gradient_steps": 2.5}, "planner_gradient_steps must be a whole number, at least 1, got 2.5"),
        (
            {"planner_gradient_steps": float("inf")},
            "planner_gradient_steps must be a whole number, at least 1, got inf",
        ),
        ({"planner_train_freq": 0}, "planner_train_freq must be a whole number, at least 1, got 0"),
        ({"planner_trial_episodes": -1}, "planner_trial_episodes must be a whole number, at least 0, got -1"),
        ({"planner_terminal_penalty": float("nan")}, "planner_terminal_penalty is a reward, got nan"),
        ({"planner_newest_fraction": 0.0}, r"in \(0, 1\], got 0"),
        ({"planner_newest_fraction": 1.5}, r"in \(0, 1\], got 1.5"),
        ({"delay_reconciled_critic": False}, "must read true states"),
    ],
)
def test_arguments_that_cannot_work_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_an_unknown_setting_is_told_where_no_other_is_given():
    with pytest.raises(ValueError, match="The planner has no setting dept; did you mean depth"):
        SAID("MlpPolicy", delayed(), planner_kwargs={"dept": 2}, buffer_size=100, device="cpu")
    with pytest.raises(ValueError, match=r"The planner's settings are a dict.* got PlannerConfig"):
        SAID("MlpPolicy", delayed(), planner_kwargs=PlannerConfig(), buffer_size=100, device="cpu")


def test_counts_may_be_written_as_floats():
    model = make(planner_gradient_steps=1e1, planner_trial_episodes=0.0).learn(25)
    assert model.policy.planner_updates == 10


@pytest.mark.parametrize(
    ("cls", "name", "nearest"),
    [
        (SAID, "planner_kwarg", "planner_kwargs"),
        (SAID, "gradient_stpes", "gradient_steps"),
        (StableSAC, "augmented_state", "augment_state"),
        (StableSAC, "tensorboard_logs", "tensorboard_log"),
    ],
)
def test_an_unknown_argument_is_told_the_nearest(cls, name, nearest):
    with pytest.raises(TypeError, match=rf"^{cls.__name__} has no argument {name}; did you mean {nearest}\?$"):
        make(cls=cls, **{name: 1})
    with pytest.raises(TypeError, match=rf"^{cls.__name__} has no argument zzz; it has action_noise, "):
        make(cls=cls, zzz=1)


def test_a_setting_of_the_planner_is_told_its_place():
    with pytest.raises(TypeError, match=r"temperature: of the planner, .* planner_kwargs=\{'temperature':"):
        make(temperature=0.5)
    with pytest.raises(ValueError, match="no setting temprature; did you mean temperature"):
        make(planner_kwargs={"temprature": 0.5})


def test_who_learns_on_without_the_replay_is_told_that_the_planner_goes(saved, trained, tmp_path):
    with pytest.warns(UserWarning, match="planner that the file has will be replaced"):
        SAID.load(saved, env=delayed(), device="cpu").learn(21)
    trained.save_replay_buffer(tmp_path / "replay")
    loaded = SAID.load(saved, env=delayed(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*will be replaced")
        loaded.learn(21)


def test_every_argument_has_a_default_and_is_an_attribute():
    parameters = list(inspect.signature(SAID.__init__).parameters.values())[3:]
    own = [p for p in parameters if p.kind is not p.VAR_KEYWORD]
    given = {
        "learning_rate": 0.01,
        "planner_kwargs": settings(),
        "planner_gradient_steps": 7,
        "planner_train_freq": 9,
        "planner_newest_fraction": 0.3,
        "planner_terminal_penalty": None,
        "planner_trial_episodes": 3,
        "planner_ways": {"eager": {"temperature": 0.1}},
        "value": "iql",
        "iql_kwargs": asdict(IQLConfig(expectile=0.8)),
        "student_width": 16,
    }
    assert [p.name for p in own] == list(given) and all(p.default is not p.empty for p in own)
    model = make(**given)
    assert {name: getattr(model, name) for name in given} == given
    assert make(planner_kwargs={}).policy.planner.config.horizon == 3
    assert SAID("MultiInputPolicy", delayed(), buffer_size=100).policy.planner.config == PlannerConfig()


# ---------------------------------------------------------------------------------------------------- files


def test_a_saved_agent_is_json_and_tensors(saved):
    with zipfile.ZipFile(saved) as archive:
        assert {name.lstrip("0123456789") for name in archive.namelist()} == {"tree.json", ".npy"}
        content = b"".join(archive.read(name) for name in archive.namelist())
    assert b":serialized:" not in content and b"cloudpickle" not in content
    assert not content.startswith(b"\x80")


def test_a_file_with_pickles_is_refused(trained, tmp_path):
    BaseAlgorithm.save(trained, tmp_path / "pickled")  # SB3's own
    with pytest.raises(ValueError, match=r"runs whatever code.*get_parameters\(\)"):
        SAID.load(tmp_path / "pickled")


def test_another_algorithms_file_is_refused(tmp_path):
    make(cls=StableSAC).save(tmp_path / "sac")
    with pytest.raises(ValueError, match="kind 'StableSAC', where 'SAID' was expected"):
        SAID.load(tmp_path / "sac")


def test_a_loaded_agent_learns_on(saved):
    loaded = SAID.load(saved, env=make_vec_env(delayed, n_envs=2), device="cpu")
    before = answer(loaded, observe())
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 60
    assert not np.array_equal(answer(loaded, observe()), before)
    with pytest.raises(ValueError, match="built for max_delay=2, but this environment has max_delay=3"):
        SAID.load(saved, env=delayed(3))
    with pytest.raises(ValueError, match="built for max_delay=2, but this environment has max_delay=3"):
        loaded.set_env(make_vec_env(lambda: delayed(3), n_envs=2))


def test_only_a_planner_of_every_delay_takes_another_one_silently(saved, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        without_planner = SAID.load(saved, env=delayed((0, 2)), device="cpu")
    without_planner.policy.planner_updates.zero_()
    without_planner.save(tmp_path / "agent")
    with pytest.warns(UserWarning, match=r"SAID learned at ages 2 and is given 0, 1:"):
        SAID.load(tmp_path / "agent", env=delayed((0, 2)), device="cpu")


@pytest.mark.parametrize("delay", [(0, 2), 1, UniformDelay(1, 2)])
def test_a_planner_for_one_age_refuses_environments_of_others(delay, tmp_path):
    with pytest.warns(UserWarning, match="mask='fixed' plans at age 2 only"):  # the expert may learn there
        make(delayed(delay, max_delay=2), planner_kwargs={"mask": "fixed"})
    model = make(planner_kwargs={"mask": "fixed"}).learn(25)
    model.save(tmp_path / "agent")
    for take in (
        lambda: model.set_env(make_vec_env(lambda: delayed(delay, max_delay=2))),
        lambda: SAID.load(tmp_path / "agent", env=delayed(delay, max_delay=2), device="cpu"),
    ):
        with (
            warnings.catch_warnings(),
            pytest.raises(ValueError, match="mask='fixed' plans at age 2 only"),
        ):
            warnings.simplefilter("error")
            take()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for same in (2, (2, 2), TotalDelay(1, (1, 1)), "HeldDelay(2)"):
            SAID.load(tmp_path / "agent", env=delayed(same), device="cpu")


def test_parameters_and_policy_are_taken_over(trained, tmp_path):
    other, obs = make(seed=3), observe()
    other.set_parameters(trained.get_parameters())
    assert np.array_equal(answer(other, obs), answer(trained, obs))  # with the planner, and that it is trained
    trained.policy.save(tmp_path / "policy")
    policy = type(trained.policy).load(tmp_path / "policy", device="cpu")
    assert np.array_equal(answer(policy, obs), answer(trained, obs))


def test_who_is_given_parameters_has_their_expert(trained):
    model = make()
    assert not model.has_expert
    model.set_parameters(trained.get_parameters())
    assert model.policy.planner_is_trained and model.has_expert
    model.set_answer("expert")
    model.set_planner(decided_by="actor")


def test_a_file_brings_its_settings_whatever_the_defaults_are_then(trained, saved, monkeypatch):
    expected, names = trained.policy.planner.config, [field.name for field in fields(PlannerConfig)]
    defaults = list(PlannerConfig.__init__.__defaults__)
    others = {"sampling_steps": 9, "choice_factor": 2.0, "embed_known": False}
    for name, value in others.items():
        assert getattr(expected, name) != value
        defaults[names.index(name)] = value
    monkeypatch.setattr(PlannerConfig.__init__, "__defaults__", tuple(defaults))
    assert PlannerConfig().choice_factor == 2.0
    loaded = SAID.load(saved, device="cpu")
    assert loaded.policy.planner.config == expected
    assert np.array_equal(answer(loaded, observe()), answer(trained, observe()))


def test_settings_that_are_given_to_load_leave_the_others_as_the_file_has_them(tmp_path):
    own = {"relative_states": False, "prediction": "epsilon"}
    model = make(planner_kwargs=own).learn(25)
    model.save(tmp_path / "agent")
    loaded = SAID.load(tmp_path / "agent", device="cpu", planner_kwargs={"n_candidates": 9}, iql_kwargs={"updates": 5})
    assert loaded.policy.planner.config == PlannerConfig(**PLANNER | own | {"n_candidates": 9})
    assert loaded.iql_kwargs == asdict(IQLConfig(updates=5))


def test_a_load_with_another_planner_names_what_the_file_has_of_it(trained, saved):
    depth = trained.planner_kwargs["depth"]
    asked = {"depth": depth + 1, "horizon": trained.planner_kwargs["horizon"]}
    with pytest.raises(SavedFileError, match=rf"saved with planner_kwargs=\{{'depth': {depth}\}}: leave out"):
        SAID.load(saved, planner_kwargs=asked, device="cpu")


def test_only_an_untrained_planner_may_be_of_other_settings(trained, tmp_path):
    expert, deeper = make(seed=4), make(planner_kwargs={"depth": 2})
    expert.save(tmp_path / "expert")
    deeper.set_parameters(tmp_path / "expert")
    assert np.array_equal(answer(deeper, observe()), answer(expert, observe()))
    assert len(deeper.policy.planner.network.blocks) == 2
    with pytest.raises(RuntimeError, match="planner"):
        deeper.set_parameters(trained.get_parameters())


@pytest.mark.parametrize(
    "other",
    [
        {"relative_states": False},
        {"prediction": "epsilon"},
        {"mask": "none"},
        {"action_transform": "tanh"},
        {"schedule": "linear"},
    ],
)
def test_a_trained_planner_is_not_taken_over_where_its_weights_mean_something_else(other, trained, saved, tmp_path):
    (name,) = other
    with pytest.raises(SavedFileError, match=f"trained with {name}=.* asked for with {name}="):
        SAID.load(saved, planner_kwargs=other, device="cpu")
    model = make(planner_kwargs=other)
    before = answer(model, observe())
    with pytest.raises(SavedFileError, match=f"{name}.* Make this agent with planner_kwargs={{'{name}': "):
        model.set_parameters(saved)
    assert np.array_equal(answer(model, observe()), before)
    make(seed=4).save(tmp_path / "untrained.zip")
    loaded = SAID.load(tmp_path / "untrained.zip", planner_kwargs=other, device="cpu")
    assert loaded.planner_kwargs[name] == other[name]


def test_an_expert_from_a_file_of_its_own_class_is_one(tmp_path):
    expert, model = make(cls=StableSAC).learn(25), make(seed=4)
    expert.save(tmp_path / "expert.zip")
    with pytest.raises(SavedFileError, match=r"it lacks \['planner"):
        model.set_parameters(tmp_path / "expert.zip")
    assert not model.has_expert
    model.set_parameters(tmp_path / "expert.zip", exact_match=False)
    assert model.has_expert
    np.testing.assert_allclose(answer(model, observe()), answer(expert, observe()), rtol=1e-4)  # rows one by one


def test_an_expert_from_a_file_without_optimizers_is_one(trained, tmp_path):
    for agent, has_expert in ((trained, True), (make(), False)):
        agent.save(tmp_path / "compact.zip", compact=True)
        model = make()
        model.set_parameters(tmp_path / "compact.zip")
        assert model.has_expert == has_expert
        model.save(tmp_path / "again.zip")
        assert SAID.load(tmp_path / "again.zip", device="cpu").has_expert == has_expert


# ---------------------------------------------------------------------------------------------------- learning


def test_training_the_planner_of_a_loaded_agent(trained, saved, tmp_path):
    loaded = SAID.load(saved, device="cpu")
    before = answer(loaded, observe())
    with pytest.raises(ValueError, match="replay buffer is empty"), warnings.catch_warnings():
        warnings.simplefilter("error")  # of a trial nothing is said
        loaded.train_planner(trial_episodes=1)
    assert np.array_equal(answer(loaded, observe()), before)
    trained.save_replay_buffer(tmp_path / "replay")
    loaded.load_replay_buffer(tmp_path / "replay")
    loaded.train_planner(3)
    assert loaded.policy.planner_updates == 3
    assert not np.array_equal(answer(loaded, observe()), before)


@pytest.mark.parametrize("name", ["gamma", "planner_terminal_penalty"])
def test_a_checkpoint_is_not_gone_on_with_where_windows_weigh_otherwise(name, tmp_path):
    model = make().learn(25)
    model.train_planner(4, tmp_path)
    setattr(model, name, 0.5)
    with pytest.raises(ValueError, match=f"{name} was .* and is now 0.5"):
        model.train_planner(4, tmp_path)


def test_counts_of_later_trainings_may_be_written_as_floats_too():
    model = make().learn(25)
    model.train_planner(3.0)
    assert model.policy.planner_updates == 3
    for steps in (2.5, 0):
        with pytest.raises(ValueError, match=f"gradient_steps must be a whole number, at least 1, got {steps}"):
            model.train_planner(steps)


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
    model = make(delayed(length=1000)).learn(25)
    assert model.policy.planner_updates == 5
    assert answer(model, observe()).shape == (7, 1)


def test_a_plain_task_is_delay_0():
    model = make("Pendulum-v1", policy="MultiInputPolicy").learn(25)
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
    model = make(vec_env).learn(60)
    assert model.policy.planner_is_trained
    assert answer(model, vec_env.reset()).shape == (2, 1)

    # The planner's data are in the expert's units, the bootstrapped values in those of the stored rewards.
    buffer, rms = model.replay_buffer, vec_env.obs_rms["observation"] if is_dict else vec_env.obs_rms
    states = buffer.observations[: buffer.size()]
    scaled = np.clip((states - rms.mean) / np.sqrt(rms.var + vec_env.epsilon), -10, 10)
    source = model.make_planner_trainer().source
    np.testing.assert_allclose(source.states[: buffer.size()], scaled, rtol=1e-4, atol=1e-6)
    pairs = source.states[: buffer.size(), 0], source.actions[: buffer.size(), 0]
    values = model._stored_values(*pairs)
    with th.no_grad():
        critic = model.policy.value(*pairs)
    np.testing.assert_allclose(values, critic * np.sqrt(vec_env.ret_rms.var + vec_env.epsilon), rtol=1e-4, atol=1e-5)


def test_a_replay_of_normalised_states_needs_their_scale(tmp_path):
    vec_env = VecNormalize(make_vec_env(delayed, n_envs=1, seed=0), norm_obs_keys=["observation"], norm_reward=False)
    model = make(vec_env).learn(25)
    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    loaded.replay_buffer = model.replay_buffer
    for learn in (loaded.train_planner, loaded.distill, lambda: loaded.learn_offline(model.replay_buffer)):
        with pytest.raises(ValueError, match=r"that VecNormalize has normalised.* load_normalization"):
            learn()
    loaded = SAID.load(tmp_path / "agent.zip", env=vec_env, device="cpu")
    loaded.replay_buffer = model.replay_buffer
    loaded.train_planner()


def test_the_newest_part_of_the_buffer():
    model = make(planner_newest_fraction=0.2, planner_kwargs={"weight_factor": 0.0}).learn(50)
    trainer = model.make_planner_trainer()
    assert trainer._settings["n_windows"] == 10
    assert trainer.source.rows.min() >= 40
    assert sorted(trainer.older.rows.tolist()) == list(range(40))  # of which the model of a step learns, too
    model.planner_newest_fraction = 1.0
    trainer = model.make_planner_trainer()
    assert trainer._settings["n_windows"] == 50 and trainer.older is None


@pytest.mark.parametrize("penalty", [-100.0, np.float32(-100), None])
def test_what_an_end_is_worth(penalty):
    kwargs = {"planner_terminal_penalty": penalty, "planner_kwargs": {"value_scale": "range"}, "learning_starts": 55}
    model = make(delayed(truncates=False), **kwargs).learn(60)
    ends = model.replay_buffer.dones[:60, 0] > 0
    model.replay_buffer.rewards[:60][ends] = 500.0  # the task is done
    source = model.make_planner_trainer().source
    at_ends = ends[source.rows.numpy()]
    assert 2 < at_ends.sum() < len(source) / 2
    np.testing.assert_array_equal(source.values[at_ends], 0.0 if penalty == -100.0 else source.values[at_ends].max())
    assert (source.values[at_ends].mean() > source.values[~at_ends].mean()) == (penalty is None)


def test_windows_weigh_what_rewards_and_critics_add_up_to():
    """Drift pays 1 a step and cuts its episodes off at step 12, from where the critics know how it goes on."""
    model = make(gamma=0.9, seed=3, planner_kwargs={"value_scale": "range"}).learn(36)
    buffer, trainer = model.replay_buffer, model.make_planner_trainer()
    source = trainer.source
    states, actions = (th.from_numpy(part[:36, 0]) for part in (buffer.observations, buffer.actions))
    with th.no_grad():
        bootstrapped = model.policy.q_value(states, actions).numpy()
    expected = np.zeros(36)
    for k in reversed(range(36)):
        expected[k] = bootstrapped[k] if k % 12 == 11 else 1.0 + 0.9 * expected[k + 1]
    expected = expected[source.rows]
    np.testing.assert_allclose(source.values, (expected - expected.min()) / np.ptp(expected), atol=1e-5)
    assert trainer.generator.initial_seed() == 3


def test_of_several_environments_the_older_steps_teach_the_guess_too():
    kwargs = {"planner_newest_fraction": 0.6, "learning_starts": 100, "planner_gradient_steps": 1}
    trainer = make(DummyVecEnv([delayed] * 2), **kwargs).learn(60).make_planner_trainer(1)
    assert trainer._settings["n_windows"] == 36 and len(trainer.older) == 24
