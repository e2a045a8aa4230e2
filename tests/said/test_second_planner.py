"""A second planner, of decisions of their own age: it learns beside the first, and the trial keeps the better one."""

from dataclasses import replace

import numpy as np
import pytest
from small_agent import answer, make, observe
from small_task import delayed, pendulum
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_said import SAID, PlannerTrainingCallback
from sb3_said.files.checkpoint import TrainingCheckpointCallback, restore_training
from sb3_said.planner import trainer as trainer_module
from sb3_said.planner.trainer import PlannerTrainer
from sb3_said.said import trial, ways
from sb3_said.said.training import PLANNER_CHECKPOINT_NAME, SECOND_CHECKPOINT_NAME

WAYS = {
    "first": {"mask": "random", "temperature": 0.0, "present": "guessed"},
    "own_ages": ways.WAYS["own_ages"],
}
SECOND = SECOND_CHECKPOINT_NAME.format(mask="own")


def make_two(delay=(0, 2), **kwargs):
    return make(env=pendulum(6, delay, 2), planner_ways=WAYS, **kwargs)


def rig(monkeypatch, best):
    """Let a trial find one way best; return which planners it was given, besides the agent's own."""
    given = []

    def play(model, n_episodes, progress_bar, should_stop, planners, _):
        given.append(planners)
        names = {"planner", *WAYS, "expert"}
        played = {name: np.full(3, float(name == best)) + np.arange(3) for name in names}
        return trial.Trial(played, np.full(3, 2.0), 9)

    monkeypatch.setattr(trial, "play_trial", play)
    return given


@pytest.fixture
def updates(monkeypatch):
    """Masks of the planners' updates, in the order they are made."""
    made, step = [], PlannerTrainer.step

    def counted(trainer):
        made.append(trainer.config.mask)
        step(trainer)

    monkeypatch.setattr(PlannerTrainer, "step", counted)
    return made


def weights(planner):
    return {name: value.clone() for name, value in planner.state_dict().items()}


def same(first, second):
    return first.keys() == second.keys() and all(bool((first[name] == second[name]).all()) for name in first)


def test_the_agent_keeps_the_planner_that_does_best(monkeypatch, updates, tmp_path):
    given = rig(monkeypatch, "own_ages")
    model = make_two(planner_trial_episodes=3)
    config = model.policy.planner.config
    model.learn(25)
    assert updates == ["random"] * 5 + ["own"] * 5
    (second,) = given[0]
    assert model.policy.planner is second and model.policy.who_answers == "planner"
    assert {name: getattr(second.config, name) for name in WAYS["own_ages"]} == WAYS["own_ages"]
    # as by itself, of those settings, but for the first guess, which is the first planner's
    first, alone = (model.make_planner_trainer(planner=model.policy.new_planner(c)) for c in (config, second.config))
    first.make_first_guess()
    alone.take_first_guess(first.average)
    alone.train()
    assert same(weights(alone.planner), weights(second))

    model.save(tmp_path / "agent.zip")
    loaded = SAID.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.planner_kwargs["mask"] == "own" and loaded.planner_ways == WAYS
    obs = pendulum(delay=(0, 2)).reset(seed=1)[0]
    np.testing.assert_array_equal(answer(loaded, obs), answer(model, obs))


def test_on_logs_what_a_trial_chose_before_is_undone(monkeypatch, updates):
    rig(monkeypatch, "own_ages")
    model = make_two(planner_trial_episodes=3)
    model.learn(25)
    chosen, obs = model.policy.planner, pendulum(delay=(0, 2)).reset(seed=1)[0]
    before = answer(model, obs)
    with pytest.raises(ValueError, match="dataset"):
        model.learn_offline(np.zeros(3))
    assert model.policy.planner is chosen and np.array_equal(answer(model, obs), before)
    updates.clear()
    model.learn_offline(model.replay_buffer, 3)
    assert updates == ["random"] * 3 and model.policy.planner is not chosen
    assert {name: getattr(model.policy.planner.config, name) for name in ways.DEFAULT_WAY} == ways.DEFAULT_WAY
    assert model.policy.planner.config.present == "guessed"
    model.set_planner(temperature=0.7)
    assert model.learn_offline(model.replay_buffer, 3).planner_kwargs["temperature"] == 0.7


def test_a_training_in_a_folder_is_gone_on_with_whichever_planner_the_agent_kept(monkeypatch, updates, tmp_path):
    rig(monkeypatch, "own_ages")
    model = make_two().learn(25)
    model.train_planner(folder=tmp_path, trial_episodes=3)
    assert model.planner_kwargs["mask"] == "own"
    second = weights(model.policy.planner)
    updates.clear()
    model.train_planner(folder=tmp_path, trial_episodes=3)
    assert updates == [] and same(weights(model.policy.planner), second)


def test_each_is_measured_as_it_would_decide(monkeypatch):
    measured, evaluate = [], PlannerTrainer.evaluate

    def told(trainer):
        measured.append((trainer.average.config.mask, trainer.average.config.present))
        return evaluate(trainer)

    monkeypatch.setattr(PlannerTrainer, "evaluate", told)
    rig(monkeypatch, "own_ages")
    model = make_two(planner_trial_episodes=3).learn(25)
    assert measured == [("random", "guessed"), ("own", "inpainted")]
    model.train_planner()  # the second is the agent's own now
    assert measured[2:] == [("own", "inpainted"), ("random", "guessed")]


def test_both_begin_with_one_first_guess(monkeypatch):
    trained, fit = [], trainer_module.fit_first_guess

    def counted(guess, *args, **kwargs):
        trained.append(guess)
        return fit(guess, *args, **kwargs)

    monkeypatch.setattr(trainer_module, "fit_first_guess", counted)
    given = rig(monkeypatch, "first")
    model = make_two(planner_trial_episodes=3).learn(25)
    ((second,),) = given
    assert len(trained) == 1
    assert same(weights(second.first_guess), weights(model.policy.planner.first_guess))
    assert not same(weights(second.network), weights(model.policy.planner.network))


def test_a_later_training_has_both_again_and_the_way_back_stands_open(monkeypatch, updates):
    rig(monkeypatch, "own_ages")
    model = make_two(planner_trial_episodes=3).learn(25)
    updates.clear()
    rig(monkeypatch, "first")
    model.train_planner()
    assert updates == ["own"] * 5 + ["random"] * 5
    config = model.policy.planner.config
    assert (config.mask, config.present, config.temperature) == ("random", "guessed", 0.0)


def test_each_way_is_played_by_its_own_planner():
    model = make_two(planner_kwargs={"warmup_steps": 0}).learn(25)  # so that the two soon differ
    first = model.policy.planner
    second = model.policy.new_planner(replace(first.config, mask="own"))
    model.make_planner_trainer(planner=second).train()
    before = first.config
    np.random.seed(3)
    played = trial.play_trial(model, 2, planners=[second]).returns
    assert list(played) == ["first", "own_ages", "planner", "expert"]
    assert model.policy.planner is first and first.config == before
    np.random.seed(3)
    seed = int(np.random.randint(2**31))
    for name, planner in (("first", first), ("own_ages", second)):
        model.policy.take_planner(planner, ways.in_way(before, WAYS[name]))
        env = DummyVecEnv([lambda: Monitor(pendulum(6, (0, 2)))])
        for i in range(2):
            env.seed(seed + i)
            assert played[name][i] == pytest.approx(evaluate_policy(model, env, 1)[0], rel=1e-5)
    assert not np.allclose(played["first"], played["own_ages"])
    model.policy.take_planner(first, before)
    assert list(trial.play_trial(model, 1).returns) == ["first", "planner", "expert"]  # whose mask none has: left out


def test_by_default_there_are_two_and_one_of_a_fixed_delay_or_without_a_trial(updates):
    tiny = {"depth": 1, "d_model": 32, "horizon": 3, "batch_size": 16}  # nothing of how to decide
    settings = {"learning_starts": 20, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    settings |= {"policy_kwargs": {"net_arch": [16]}, "planner_kwargs": tiny, "planner_gradient_steps": 2}
    for delay, episodes, masks in (((0, 2), 1, ["random", "own"]), (2, 1, ["random"]), ((0, 2), 0, ["random"])):
        updates.clear()
        SAID("MlpPolicy", pendulum(6, delay, 2), planner_trial_episodes=episodes, **settings).learn(25)
        assert updates == [mask for mask in masks for _ in range(2)]
    assert make(env=delayed(), planner_ways={}).learn(25).policy.planner.config.mask == "random"


def test_logs_do_not_tell_at_which_age_their_decisions_were_made(updates):
    model, other = make_two().learn(25), make_two(seed=1).learn(25)
    model.take_dataset(other.replay_buffer)
    updates.clear()
    model.train_planner(trial_episodes=1)
    assert updates == ["random"] * 5


def test_trainings_amid_learning_are_of_the_first_alone(updates):
    make_two(planner_trial_episodes=1, planner_train_freq=21).learn(25)
    assert updates == ["random"] * 10 + ["own"] * 5  # at 21 steps, and at the end


def test_a_training_stopped_amid_the_second_goes_on_there(monkeypatch, updates, tmp_path):
    rig(monkeypatch, "own_ages")
    whole = make_two(planner_trial_episodes=3).learn(25)
    stopped = make_two(planner_trial_episodes=0).learn(25)
    updates.clear()
    with pytest.raises(KeyboardInterrupt):
        stopped.train_planner(folder=tmp_path, trial_episodes=3, should_stop=lambda: updates.count("own") == 2)
    assert updates == ["random"] * 5 + ["own"] * 2
    assert {path.name for path in tmp_path.iterdir()} == {PLANNER_CHECKPOINT_NAME, SECOND}
    assert stopped.policy.planner.config.mask == "random" and stopped.policy.planner_updates == 5
    updates.clear()
    stopped.train_planner(folder=tmp_path, trial_episodes=3)
    assert updates == ["own"] * 3
    assert same(weights(stopped.policy.planner), weights(whole.policy.planner))


def test_after_a_file_a_training_that_is_done_is_found_again(monkeypatch, updates, tmp_path):
    rig(monkeypatch, "own_ages")
    model = make_two(planner_trial_episodes=0).learn(25)
    model.train_planner(folder=tmp_path, trial_episodes=3)
    assert model.policy.planner.config.mask == "own"
    model.save(tmp_path / "agent.zip")
    model.save_replay_buffer(tmp_path / "replay.zip")
    loaded = SAID.load(tmp_path / "agent.zip", env=model.env, device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    updates.clear()
    loaded.train_planner(folder=tmp_path, trial_episodes=3)
    assert updates == [] and same(weights(loaded.policy.planner), weights(model.policy.planner))


@pytest.mark.parametrize("best", WAYS)
def test_a_checkpoint_answers_as_the_trial_chose(best, monkeypatch, tmp_path):
    rig(monkeypatch, best)
    agents = [make_two(planner_trial_episodes=3) for _ in range(2)]
    agents[0].learn(25, callback=[PlannerTrainingCallback(), TrainingCheckpointCallback(tmp_path)])
    restore_training(agents[1], tmp_path / "checkpoint.zip")
    assert agents[1].planner_kwargs == agents[0].planner_kwargs
    obs = observe(5, pendulum(delay=2, max_delay=2))
    np.testing.assert_array_equal(*(answer(agent, obs) for agent in agents))


def test_ctrl_c_amid_the_second_leaves_the_first_without_a_trial(monkeypatch, updates, capsys):
    given, step = rig(monkeypatch, "own_ages"), PlannerTrainer.step

    def interrupted(trainer):
        if updates.count("own") == 2:
            raise KeyboardInterrupt
        step(trainer)

    monkeypatch.setattr(PlannerTrainer, "step", interrupted)
    model = make_two(planner_trial_episodes=3).learn(25)
    assert given == [] and model.policy.who_answers == "planner"
    assert model.policy.planner.config.mask == "random" and model.policy.planner_updates == 5
    assert "planner of mask='own' interrupted after 2 of 5 updates; it is left out" in capsys.readouterr().out


def test_rows_of_the_second_are_logged_behind_those_of_the_first(monkeypatch, tmp_path):
    rig(monkeypatch, "own_ages")
    model = make_two().learn(25)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    rows = []
    monkeypatch.setattr(model.logger.output_formats[0], "write", lambda row, _, step: rows.append((step, {**row})))
    model.train_planner(log_interval=2, trial_episodes=3)
    assert [step for step, _ in rows] == [27, 29, 30, 32, 34, 35, 35]
    assert "trial/own_ages_return" in rows[-1][1]


def test_settings_that_are_of_no_way_to_decide_are_refused():
    with pytest.raises(ValueError, match=r"'x': \{'depth': 3\}.*decided_by, mask"):
        make(planner_ways={"x": {"depth": 3}})
    with pytest.raises(ValueError, match="mask"):
        make(planner_ways={"x": {"mask": "other"}})
