"""Training the planner: when, on what, with what to watch it by, and on from where it was interrupted."""

import io
import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from kill import Kill, Killed
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.logger import DISABLED, KVWriter, Logger

from sb3_said import SAID, DelayedObservationWrapper, PlannerTrainingCallback, StableSAC
from sb3_said.files import checkpoint
from sb3_said.files.archive import SavedFileError, load_tree, save_tree
from sb3_said.files.checkpoint import TrainingCheckpointCallback, restore_training
from sb3_said.planner import InpaintingPlanner
from sb3_said.planner import trainer as trainer_module
from sb3_said.planner.first_guess import ROLLED_EACH
from sb3_said.planner.trainer import GUESS_UPDATES_EACH, PlannerTrainer
from sb3_said.said import training as training_module
from sb3_said.said.training import PLANNER_CHECKPOINT_NAME

PLANNER = {"d_model": 32, "depth": 1, "horizon": 3, "batch_size": 16, "sampling_steps": 2, "n_candidates": 3}


def make(**kwargs):
    env = DelayedObservationWrapper(gym.make("Pendulum-v1", max_episode_steps=15), 2)
    arguments = {"learning_starts": 5, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    arguments |= {
        "policy_kwargs": {"net_arch": [16]},
        "planner_kwargs": PLANNER,
        "planner_gradient_steps": 6,
        "planner_newest_fraction": 1.0,
        "planner_trial_episodes": 0,
    }
    return SAID("MlpPolicy", env, **(arguments | kwargs))


def planner_of(model):
    return {name: value.clone() for name, value in model.policy.planner.state_dict().items()}


def assert_same(first, second):
    th.testing.assert_close(first, second, rtol=0, atol=0)


def differ(first, second):
    return any(not th.equal(first[name], second[name]) for name in first)


class Memory(KVWriter):
    """Keeps the rows of a log."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append({**key_values, "step": step})

    def close(self):
        pass


@pytest.fixture
def trainings(monkeypatch):
    """The trainers that made updates, each with how many."""
    made, original = {}, PlannerTrainer.step

    def step(self):
        made.setdefault(self, 0)
        original(self)
        made[self] += 1

    monkeypatch.setattr(PlannerTrainer, "step", step)
    return made


def begun(trainings):
    """Return the stored steps that each training began with."""
    return [trainer._settings["n_windows"] for trainer in trainings]


@pytest.mark.parametrize("is_worse", [False, True])
def test_a_planner_worse_than_the_regression_is_not_called_done(is_worse, monkeypatch):
    errors = {"planner/present_error_d2": 1.0 + is_worse, "planner/present_error_mlp_d2": 1.0}
    monkeypatch.setattr(PlannerTrainer, "evaluate", lambda self: errors)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make().learn(15)
    told = [str(w.message) for w in caught if "worse than a small regression" in str(w.message)]
    assert len(told) == is_worse and all("present_error_d2 2 against 1" in message for message in told)


@pytest.mark.parametrize(("name", "most", "more"), [
    ("present", 20, "data"), ("action", 20, "planner_gradient_steps, or more data"),
    ("present", 40, "planner_gradient_steps, or more data"),
])  # fmt: skip
def test_more_updates_are_no_advice_where_the_first_guess_has_had_all_of_its_own(name, most, more, monkeypatch):
    """Six updates of the planner, and up to five of the guess for each."""
    errors = {f"planner/{name}_error_d2": 2.0, f"planner/{name}_error_mlp_d2": 1.0}
    monkeypatch.setattr(PlannerTrainer, "evaluate", lambda self: errors)
    monkeypatch.setattr(training_module, "GUESS_UPDATES", most)
    with pytest.warns(UserWarning, match=rf"It is undertrained; give it more {more}\."):
        make().learn(15)


def interrupt_at(monkeypatch, update, error):
    """Let the update of this number fail, once."""
    original, raised = PlannerTrainer.step, []

    def step(self):
        if self.n_updates == update and not raised:
            raised.append(True)
            raise error
        original(self)

    monkeypatch.setattr(PlannerTrainer, "step", step)


# ---------------------------------------------------------------------------------------------------- when


@pytest.mark.parametrize(
    ("planner_train_freq", "expected"), [(None, [20]), (8, [8, 16, 20]), (10, [10, 20]), (60, [20])]
)
def test_when_the_planner_is_trained(trainings, planner_train_freq, expected):
    model = make(planner_train_freq=planner_train_freq, planner_gradient_steps=2).learn(20)
    assert begun(trainings) == expected
    assert list(trainings.values()) == [2] * len(expected)
    assert model.policy.planner_updates == 2


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_before_the_expert_has_learned_no_planner_imitates_random_actions(trainings, gamma):
    make(planner_train_freq=5, gamma=gamma, planner_gradient_steps=1).learn(12)  # learning_starts is 5
    assert begun(trainings) == [6, 10, 12]


def test_learning_on_and_counting_anew(trainings):
    model = make(planner_train_freq=10, planner_gradient_steps=1).learn(17)
    assert begun(trainings) == [10, 17]
    model.learn(8, reset_num_timesteps=False)
    assert begun(trainings)[2:] == [20, 25]
    model.learn(0, reset_num_timesteps=False)
    assert len(trainings) == 4
    model.learn(13)  # steps 0 to 13 again, on top of the 25 stored
    assert begun(trainings)[4:] == [35, 38]


def test_a_second_learn_begins_with_random_actions_and_says_so_where_it_ends_there(trainings):
    model = make(planner_train_freq=3, planner_gradient_steps=1).learn(7)
    trainings.clear()
    with pytest.warns(UserWarning, match="random actions, which the newest 4 steps are: .* reset_num_timesteps=False"):
        model.learn(4)
    assert begun(trainings) == [11]  # rows stored


def test_an_agent_that_was_saved_amid_learning_collects_before_its_planner_is_trained(trainings, tmp_path):
    make(planner_train_freq=8, planner_gradient_steps=1).learn(17, CheckpointCallback(8, str(tmp_path)))
    trainings.clear()
    loaded = SAID.load(tmp_path / "rl_model_16_steps.zip", env=make().env, device="cpu")
    loaded.learn(5, reset_num_timesteps=False)
    assert begun(trainings) == [1, 5] and loaded.num_timesteps == 21


def test_a_callback_of_the_users_is_the_one_that_trains(trainings, tmp_path):
    mine = PlannerTrainingCallback(folder=tmp_path)
    make().learn(15, CallbackList([CallbackList([mine])]))
    assert begun(trainings) == [15] and (tmp_path / PLANNER_CHECKPOINT_NAME).exists()
    mine.on_training_end()  # some callers end a training twice
    assert len(trainings) == 1


class Stopping(CallbackList):
    """A user's own list of callbacks, which ends training itself and looks at what SB3 shows it."""

    def __init__(self, children):
        super().__init__(children)
        self.seen = []

    def _on_step(self):
        self.seen.append((self.locals["num_collected_steps"], self.model.num_timesteps, self.callbacks[0].n_calls))
        return super()._on_step() and self.num_timesteps < 8


class Child(BaseCallback):
    def _on_step(self):
        return True


@pytest.mark.parametrize("progress_bar", [False, True])
@pytest.mark.parametrize("trains_itself", [False, True])
def test_a_list_of_the_users_own_is_asked_as_a_whole(trainings, trains_itself, progress_bar):
    own = Stopping([Child()] + [PlannerTrainingCallback()] * trains_itself)
    model = make().learn(20, own, progress_bar=progress_bar)
    assert model.num_timesteps == 8  # it was asked, and ended training
    assert own.seen == [(1, t, t - 1) for t in range(1, 9)] and own.locals["self"] is model
    assert len(trainings) == 1


@pytest.mark.parametrize("form", ["list", "tuple", "function", "callback", "none"])
def test_every_form_of_callbacks_that_sb3_takes(trainings, form):
    asked = []

    def ask(locals_, globals_):
        asked.append(locals_["self"].num_timesteps)
        return len(asked) < 7

    child = Child()
    forms = {"list": [child], "tuple": (child,), "function": ask, "callback": child, "none": None}
    model = make().learn(10, forms[form])
    assert asked == ([*range(1, 8)] if form == "function" else [])
    assert child.n_calls == (10 if form in ("list", "tuple", "callback") else 0)
    assert begun(trainings) == [6 if form == "function" else 10] and model.policy.planner_is_trained


def test_no_network_lives_in_the_callback():
    callback = PlannerTrainingCallback()
    model = make().learn(15, callback)

    def holds_tensors(value):
        return isinstance(value, (th.nn.Module, th.Tensor, th.optim.Optimizer, PlannerTrainer))

    of_sb3 = {"model", "locals", "globals", "parent"}
    own = [value for name, value in vars(callback).items() if name not in of_sb3]
    assert callback.model is model and not any(map(holds_tensors, own))


# ---------------------------------------------------------------------------------------------------- watching


def test_losses_are_logged_and_a_bar_is_shown(capsys):
    memory = Memory()
    model = make(planner_gradient_steps=5, learning_starts=50)
    model.set_logger(Logger(None, [memory]))
    model.learn(60, PlannerTrainingCallback(log_interval=2, eval_interval=4, progress_bar=True), log_interval=None)
    rows = [row for row in memory.rows if "planner/loss" in row]
    assert [row["planner/n_updates"] for row in rows] == [2, 4, 5]
    assert [row["step"] for row in rows] == [62, 64, 65]  # nothing comes after, and a curve needs an axis
    assert [row["time/total_timesteps"] for row in rows] == [62, 64, 65]  # in a CSV, too
    assert all(np.isfinite(row["planner/loss"]) and row["planner/loss"] > 0 for row in rows)
    assert ["planner/present_error_d2" in row for row in rows] == [False, True, True]
    shown = capsys.readouterr().err
    assert "planner: 100%" in shown and "5/5" in shown
    make().learn(15, PlannerTrainingCallback())
    assert "planner" not in capsys.readouterr().err


def test_rows_of_the_planner_are_its_own_and_in_order():
    memory = Memory()
    model = make(planner_train_freq=16)
    model.set_logger(logger := Logger(None, [memory]))
    model.learn(35, PlannerTrainingCallback(log_interval=2), log_interval=1)
    of_planner = [row for row in memory.rows if "planner/loss" in row]
    of_expert = [row for row in memory.rows if "planner/loss" not in row]
    assert [row["planner/n_updates"] for row in of_planner] == 3 * [2, 4, 6]
    axes = {"step", "time/total_timesteps"}
    assert all(key.startswith("planner/") for row in of_planner for key in row.keys() - axes)
    assert not any(key.startswith("planner/") for row in of_expert for key in row)
    steps = [row["step"] for row in memory.rows]
    assert steps == sorted(steps) and len(set(steps)) > 3
    # What is recorded and not yet written waits for its own row
    logger.record("mine", 1.0)
    logger.record_mean("mean", 3.0)
    model.train_planner()
    assert logger.name_to_value["mine"] == 1.0 and "mine" not in memory.rows[-1]
    logger.record_mean("mean", 5.0)
    assert logger.name_to_value["mean"] == 4.0
    held = dict(logger.name_to_value)
    logger.set_level(DISABLED)  # which writes nothing, and forgets nothing by itself
    model.train_planner()
    assert dict(logger.name_to_value) == held


class Forwarding(Logger):
    """As a logger that puts those of several learners into one."""

    def __init__(self, to):
        super().__init__(None, [])
        self.to = to

    def record(self, key, value, exclude=None):
        self.to.record(key, value, exclude)

    def dump(self, step=0):
        self.to.dump(step)


def test_rows_of_the_planner_go_where_those_of_the_expert_do():
    memory = Memory()
    model = make()
    model.set_logger(Forwarding(Logger(None, [memory])))
    model.learn(20, log_interval=1)
    assert any("planner/loss" in row for row in memory.rows) and any("time/episodes" in row for row in memory.rows)


@pytest.mark.parametrize(("how", "is_told"), [({}, True), ({"progress_bar": True}, False), ({"verbose": 1}, False)])
def test_a_training_that_shows_nothing_says_that_it_begins(how, is_told, capsys):
    verbose = how.pop("verbose", 0)
    make(verbose=verbose).learn(10, PlannerTrainingCallback(**how))
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Training the planner: 6 updates")]
    assert len(told) == is_told and all("progress_bar=True" in line for line in told)


# ---------------------------------------------------------------------------------------------------- cancelling


def test_cancelling_early_keeps_the_weights(monkeypatch, capsys):
    whole = make()
    untrained = planner_of(whole)
    interrupt_at(monkeypatch, 3, KeyboardInterrupt)
    model = make().learn(15)
    assert "interrupted after 3 of 6 updates" in capsys.readouterr().out
    assert model.policy.planner_updates == 3 and differ(planner_of(model), untrained)
    answers = [model.predict(model.env.reset(), deterministic=True)[0] for _ in range(2)]
    assert np.isfinite(answers).all()
    kept = planner_of(model)
    file = io.BytesIO()
    model.save(file)
    assert_same(planner_of(SAID.load(file, device="cpu")), kept)


def retrain_on_other_data(model):
    model.replay_buffer.observations *= 3.0
    model.train_planner()


def test_cancelling_before_the_first_update_keeps_an_earlier_planner(monkeypatch, capsys):
    model = make().learn(15)
    kept = planner_of(model)
    interrupt_at(monkeypatch, 0, KeyboardInterrupt)
    retrain_on_other_data(model)
    assert "stays as it was" in capsys.readouterr().out
    assert model.policy.planner_is_trained and model.policy.planner_updates == 6
    assert_same(planner_of(model), kept)  # its normaliser, too


@pytest.mark.parametrize("is_trained", [False, True])
def test_a_training_that_diverges_leaves_the_planner_as_it_was(monkeypatch, is_trained):
    model = make()
    if is_trained:
        model.learn(15)
    kept, loss = planner_of(model), InpaintingPlanner.loss

    def breaks(*args, **kwargs):
        return loss(*args, **kwargs) * np.nan

    monkeypatch.setattr(InpaintingPlanner, "loss", breaks)
    with pytest.raises(FloatingPointError, match="stays as it was"):
        retrain_on_other_data(model) if is_trained else model.learn(15)
    assert_same(planner_of(model), kept)
    assert model.policy.who_answers == ("planner" if is_trained else "expert")
    assert np.isfinite(model.predict(model.env.reset(), deterministic=True)[0]).all()


def test_cancelling_one_of_several_trainings_does_not_end_learning(monkeypatch, trainings):
    interrupt_at(monkeypatch, 2, KeyboardInterrupt)
    model = make(planner_train_freq=8).learn(20)
    assert begun(trainings) == [8, 16, 20] and list(trainings.values()) == [2, 6, 6]
    assert model.num_timesteps == 20


# ---------------------------------------------------------------------------------------------------- going on


@pytest.fixture(scope="module")
def whole():
    """An agent of 15 steps; tests must leave it as it is."""
    return make().learn(15)


@pytest.mark.parametrize("killed_at", [1, 4, 5])
def test_a_killed_training_ends_as_if_it_had_not_been_killed(whole, tmp_path, monkeypatch, trainings, killed_at):
    def callbacks():
        return [TrainingCheckpointCallback(tmp_path, 5), PlannerTrainingCallback(folder=tmp_path, save_interval=2)]

    interrupt_at(monkeypatch, killed_at, Killed())
    with pytest.raises(Killed):
        make().learn(15, callbacks())
    resumed = make()
    untrained = planner_of(resumed)
    restore_training(resumed, tmp_path / "checkpoint.zip")
    assert resumed.num_timesteps == 15 and not resumed.policy.planner_is_trained
    trainings.clear()
    resumed.learn(0, callbacks(), reset_num_timesteps=False)
    assert list(trainings.values()) == [6 - killed_at // 2 * 2]  # from the last checkpoint, or from the start
    assert_same(resumed.policy.state_dict(), whole.policy.state_dict())
    assert differ(planner_of(resumed), untrained)


@pytest.mark.parametrize(
    ("save_freq", "killed_at", "planner_first"),
    [(5, 12, True), (5, 10, True), (5, 10, False), (5, 17, True), (10, 19, False)],
)
def test_a_resumed_run_loses_and_repeats_no_training(tmp_path, trainings, save_freq, killed_at, planner_first):
    def callbacks():
        both = [TrainingCheckpointCallback(tmp_path, save_freq), PlannerTrainingCallback(folder=tmp_path)]
        return both[::-1] if planner_first else both

    with pytest.raises(Killed):
        make(planner_train_freq=10).learn(24, [*callbacks(), Kill(killed_at)])
    before = begun(trainings)
    assert before == [n for n in (10, 20) if n < killed_at]
    resumed = make(planner_train_freq=10)
    restore_training(resumed, tmp_path / "checkpoint.zip")
    at = resumed.num_timesteps
    trainings.clear()
    resumed.learn(24 - at, callbacks(), reset_num_timesteps=False)
    # What came after the checkpoint is made again, on the new data; a training at the checkpoint itself is in it
    # or beside it, in the planner's own.
    assert begun(trainings) == [n for n in (10, 20, 24) if n > at or (n == at and n not in before)]
    assert resumed.policy.planner_updates == 6


def test_the_planners_checkpoints_are_spread_by_time_and_size(tmp_path, monkeypatch):
    """Ten minutes apart, and 2,000 s apart once the file has a gigabyte; an update takes 200 s."""
    written, now = [], [0.0]

    def save(path, state, metadata):
        written.append(now[0])
        with open(path, "wb") as file:
            file.truncate(10**9 if now[0] > 1_500 else 10)

    monkeypatch.setattr(checkpoint, "save_tree", save)
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    model = make().learn(15)

    def pass_time(trainer):
        now[0] += 200.0
        return original(trainer)

    original = PlannerTrainer.step
    monkeypatch.setattr(PlannerTrainer, "step", pass_time)
    model.train_planner(30, folder=tmp_path)
    assert written == [600, 1200, 1800, 3800, 5800, 6000]


def test_a_stop_amid_one_of_several_trainings_loses_no_update(tmp_path, trainings, monkeypatch):
    monkeypatch.setattr(trainer_module, "GUESS_PASSES", 10_000)  # so that few rows do not end it
    asked, of_guess = [], 6 * GUESS_UPDATES_EACH  # of single steps; then of many

    def should_stop():
        asked.append(True)
        return len(asked) == of_guess + math.ceil(of_guess / ROLLED_EACH) + 4  # of six updates the fourth

    checkpointing = TrainingCheckpointCallback(tmp_path, 1000)
    with pytest.raises(KeyboardInterrupt):
        make(planner_train_freq=10).learn(
            15, [checkpointing, PlannerTrainingCallback(folder=tmp_path, should_stop=should_stop)]
        )
    assert checkpointing.save() and list(trainings.values()) == [4]
    resumed = make(planner_train_freq=10)
    restore_training(resumed, tmp_path / "checkpoint.zip")
    trainings.clear()
    resumed.learn(5, PlannerTrainingCallback(folder=tmp_path), reset_num_timesteps=False)
    assert begun(trainings) == [10, 15] and list(trainings.values()) == [2, 6]


def test_a_checkpoint_of_other_data_is_not_gone_on_from(tmp_path, trainings):
    callback = PlannerTrainingCallback(folder=tmp_path)
    first = make().learn(15, callback)
    make(seed=1).learn(15, PlannerTrainingCallback(folder=tmp_path))  # as many steps, but other ones
    assert list(trainings.values()) == [6, 6]
    second = make().learn(15, PlannerTrainingCallback(folder=tmp_path))
    assert list(trainings.values()) == [6, 6, 6]
    third = make().learn(15, PlannerTrainingCallback(folder=tmp_path))  # the very same: nothing is left to do
    assert list(trainings.values()) == [6, 6, 6]
    for again in (second, third):
        assert_same(planner_of(again), planner_of(first))


def test_a_checkpoint_of_other_settings_is_refused(tmp_path):
    make().learn(15, PlannerTrainingCallback(folder=tmp_path))
    with pytest.raises(ValueError, match="gradient_steps was 6 and is now 7"):
        make(planner_gradient_steps=7).learn(15, PlannerTrainingCallback(folder=tmp_path))


@pytest.mark.parametrize("state", [{}, [], {"trainer": {}}], ids=str)
def test_a_checkpoint_of_something_else_is_refused(state, tmp_path):
    model = make().learn(15, PlannerTrainingCallback(folder=tmp_path))
    path = tmp_path / PLANNER_CHECKPOINT_NAME
    kept = load_tree(path)
    save_tree(path, state if state != {"trainer": {}} else {**kept, **state})
    with pytest.raises(SavedFileError, match="Cannot load"):
        model.train_planner(folder=tmp_path)


def test_unknown_intervals_are_refused_before_the_training():
    with pytest.raises(TypeError, match="no argument save_freq"):
        PlannerTrainingCallback(save_freq=5)
    for wrong in ({"eval_interval": 0}, {"log_interval": 0.5}, {"save_interval": -1}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be a whole number, at least 1"):
            PlannerTrainingCallback(**wrong)
    model = make()
    for wrong in ({"trial_episodes": -1}, {"trial_episodes": 0.5}, {"eval_interval": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            model.train_planner(**wrong)


@pytest.mark.parametrize(("interval", "expected"), [(None, [6]), (4, [4, 6]), (2, [2, 4, 6])])
def test_held_out_errors_are_measured_at_the_end_and_as_often_as_asked(interval, expected):
    memory, model = Memory(), make()
    model.set_logger(Logger(None, [memory]))
    model.learn(15, PlannerTrainingCallback(log_interval=1, eval_interval=interval))
    rows = [row for row in memory.rows if "planner/action_error_d0" in row or "planner/action_error_d2" in row]
    assert [row["planner/n_updates"] for row in rows] == expected


def test_an_agent_without_planner_is_refused_by_name():
    with pytest.raises(TypeError, match=r"PlannerTrainingCallback trains SAID's planner, got StableSAC: leave it out"):
        StableSAC("MlpPolicy", "Pendulum-v1", buffer_size=9, device="cpu").learn(2, PlannerTrainingCallback())


def test_without_an_interval_there_is_one_row_at_the_end_as_with_one_of_all_updates():
    rows = []
    for interval in (None, 5):
        memory = Memory()
        model = make(planner_gradient_steps=5)
        model.set_logger(Logger(None, [memory]))
        model.learn(15, callback=PlannerTrainingCallback(log_interval=interval), log_interval=None)
        rows.append([row["planner/n_updates"] for row in memory.rows if "planner/n_updates" in row])
    assert rows == [[5], [5]]


def test_a_file_of_a_second_training_answers_as_the_callback_saw_it(tmp_path):
    """The planner of before is trained, and knows nothing of what the expert learns now."""
    model = make().learn(10)
    obs = model.observation_space.sample()
    obs["delay"][:] = 2
    seen = []

    class Saving(BaseCallback):
        def _on_step(self):
            if not seen:
                model.save(tmp_path / "best_model.zip")
                seen.append(model.predict(obs, deterministic=True)[0])
            return True

    model.learn(5, callback=Saving(), reset_num_timesteps=False)
    loaded = SAID.load(tmp_path / "best_model.zip", device="cpu")
    assert loaded.policy.who_answers == "expert" and model.policy.who_answers == "planner"
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], seen[0])


@pytest.mark.parametrize("what", ["trial", "student"])
def test_an_environment_that_a_callback_has_played_begins_new_episodes(what):
    class Plays(BaseCallback):
        has_played = False

        def _on_rollout_start(self):
            if self.num_timesteps == 20 and not self.has_played:
                self.has_played = True
                self.model.train_planner(3, trial_episodes=1)
                if what == "student":
                    self.model.distill(8, n_labels=20, own_steps=10, rounds=1, gradient_steps=4)

        def _on_step(self):
            return True

    callback = Plays()
    model = make().learn(25, callback)
    assert callback.has_played and model.num_timesteps == 25
    steps = model.replay_buffer.steps[:25, 0]
    assert steps[20] == 0 and model.replay_buffer.size() == 25
