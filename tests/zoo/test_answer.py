"""The planner's own evaluation: what rl_zoo3's plots show for said, beside its expert's."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

import small_agent
from small_task import delayed, pendulum
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from trained_run import ENV, PLANNER, train_run

from sb3_said import SAID
from sb3_said.evaluation.plots import plot_learning_curve
from sb3_said.sac import StableSAC
from sb3_said.zoo.answer import StoppableEvaluation, evaluate_answer
from sb3_said.zoo.stopping import Stopping

EVALUATED = ("--eval-freq", "60", "--eval-episodes", "2")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    planner = ("planner_gradient_steps:3", "planner_trial_episodes:0", f"planner_kwargs:{PLANNER}")
    train_run(folder, "said", *planner, options=EVALUATED)
    train_run(folder, "stable", options=EVALUATED)
    return folder


def returns_of(file: Path) -> dict[int, list[float]]:
    with np.load(file) as loaded:
        return dict(zip(loaded["timesteps"].tolist(), loaded["results"].tolist(), strict=True))


def test_planner_and_expert_are_told_apart(logs: Path) -> None:
    (said,), (stable,) = ((logs / algo).iterdir() for algo in ("said", "stable"))
    expert, planner = returns_of(said / "expert" / "evaluations.npz"), returns_of(said / "evaluations.npz")
    # The expert is StableSAC, evaluated as it learns; the planner is evaluated when it has been trained.
    assert expert == returns_of(stable / "evaluations.npz") and list(expert) == [60, 120]
    with np.load(said / "evaluations.npz") as file:
        assert file["answers"].tolist() == ["", "planner"]
    assert list(planner) == [0, 120] and np.isnan(planner[0]).all() and np.isfinite(planner[120]).all()
    best, of_expert = (SAID.load(folder / "best_model.zip", device="cpu") for folder in (said, said / "expert"))
    assert best.policy.planner_is_trained and not of_expert.policy.planner_is_trained
    assert "eval/answer_mean_reward" in (said / "progress.csv").read_text().splitlines()[0]


@pytest.mark.parametrize("has_an_end", [True, False])
def test_an_evaluation_whose_episode_may_have_no_end_is_warned_of(
    has_an_end: bool, recwarn: pytest.WarningsRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.import_module("sb3_said.evaluation.rollout"), "LONG", 30)
    venv = DummyVecEnv([lambda: Monitor(delayed(length=30 if has_an_end else 31))])
    evaluation = StoppableEvaluation(venv, Stopping(), eval_freq=10, n_eval_episodes=1, verbose=0)
    small_agent.make(cls=StableSAC).learn(10, callback=evaluation)
    told = [str(w.message) for w in recwarn if "has not ended after 30 steps" in str(w.message)]
    assert len(told) == (0 if has_an_end else 1)


@pytest.mark.parametrize("max_steps", [1000, 90])
def test_the_plots_of_rl_zoo3_show_the_planner(
    max_steps: int, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setitem(sys.modules, "seaborn", SimpleNamespace(set=lambda: None))  # styles only
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    from rl_zoo3.plots import all_plots

    words = f"all_plots -a stable said -e {ENV}-delay2 -f {logs} -max {max_steps} --no-display -o {tmp_path / 'out'}"
    monkeypatch.setattr(sys, "argv", words.split())
    all_plots()
    shown = np.load(tmp_path / "out.pkl", allow_pickle=True)[f"{ENV}-delay2"]
    (said,), (stable,) = ((logs / algo).iterdir() for algo in ("said", "stable"))
    last = 120 if max_steps == 1000 else 60
    assert shown[f"STABLE-{logs}"]["last_evals"] == np.mean(returns_of(stable / "evaluations.npz")[last])
    # A planner that was trained after the steps shown is not there, and neither is its expert in its place.
    expected = np.mean(returns_of(said / "evaluations.npz")[120 if max_steps == 1000 else 0])
    np.testing.assert_equal(shown[f"SAID-{logs}"]["last_evals"], expected)


def test_the_learning_curve_has_both(logs: Path) -> None:
    pytest.importorskip("matplotlib")
    (said,) = (logs / "said").iterdir()
    lines = {
        line.get_label().partition(",")[0]: line.get_xdata().tolist() for line in plot_learning_curve(said).lines[2:]
    }
    assert lines == {"evaluation of the expert": [60, 120], "evaluation of the trained agent": [120]}


def test_a_later_planner_is_added_and_the_best_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_agent.make()
    model.set_logger(Logger(None, []))
    like = EvalCallback(Monitor(delayed()), n_eval_episodes=2)
    means = iter([5.0, 4.0, 6.0, 1.0])
    monkeypatch.setattr(
        "sb3_said.zoo.answer.evaluate_policy", lambda *_, **__: (lambda mean: ([mean] * 2, [9] * 2))(next(means))
    )
    kept = []
    for steps in (100, 200, 300, 300):  # the last step twice: a resume of a run that had ended
        model.num_timesteps = steps
        evaluate_answer(model, like, tmp_path, Stopping())
        kept.append(SAID.load(tmp_path / "best_model.zip", device="cpu").num_timesteps)
    assert kept == [100, 100, 300, 300]
    rows = returns_of(tmp_path / "evaluations.npz")
    assert {step: np.mean(row) for step, row in rows.items() if step} == {100: 5.0, 200: 4.0, 300: 1.0}


@pytest.mark.parametrize("damage", ["cut", "another file"])
def test_evaluations_that_cannot_be_read_are_begun_anew(damage: str, tmp_path: Path) -> None:
    """Else a resume would lose what it trained, each time."""
    model, file = small_agent.make(), tmp_path / "evaluations.npz"
    model.set_logger(Logger(None, []))
    model.num_timesteps = 100
    np.savez(file, timesteps=[50])
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-30])
    with pytest.warns(UserWarning, match="cannot be read .* begun anew"):
        evaluate_answer(model, EvalCallback(Monitor(delayed()), n_eval_episodes=2), tmp_path, Stopping())
    assert list(returns_of(file)) == [0, 100] and (tmp_path / "best_model.zip").is_file()


def test_the_episodes_are_the_same_whatever_was_evaluated_before(tmp_path: Path) -> None:
    """As a run that goes on after a stop has new environments."""

    def evaluation() -> EvalCallback:
        return EvalCallback(Monitor(pendulum()), n_eval_episodes=2)

    used = evaluation()
    model = small_agent.make(used.eval_env, seed=3)
    model.set_logger(Logger(None, []))
    for steps, like in ((100, used), (200, used), (300, evaluation())):
        model.num_timesteps = steps
        evaluate_answer(model, like, tmp_path, Stopping())
    rows = returns_of(tmp_path / "evaluations.npz")
    assert rows[100][0] != rows[100][1]
    np.testing.assert_array_equal(rows[200], rows[100])
    np.testing.assert_array_equal(rows[300], rows[100])


def test_an_evaluation_can_be_stopped(tmp_path: Path) -> None:
    model, stopping = small_agent.make(), Stopping()
    stopping.is_asked = True
    with pytest.raises(KeyboardInterrupt):
        evaluate_answer(model, EvalCallback(Monitor(delayed()), n_eval_episodes=2), tmp_path, stopping)
    assert list(tmp_path.iterdir()) == []
