"""The agents of agents/, as whoever clones the project meets them."""

import hashlib
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from drawing import need_a_renderer

from sb3_said.zoo import enjoy
from sb3_said.zoo.runs import load_run

FOLDER = Path(__file__).parents[1] / "agents"
AGENTS = {file.name: file for file in sorted(FOLDER.glob("*.zip"))}
FIRST_ACTIONS = json.loads((FOLDER / "first_actions.json").read_text())
DELAY = 12


def first_actions(file: Path) -> list[list[float]]:
    """Return what an agent does at the reset of seed 0, and at the age of 12 steps after as many without action."""
    run = load_run(file, delay=DELAY, device="cpu")
    env = run.make_env()
    observation, _ = env.reset(seed=0)
    actions = [run.model.predict(observation, deterministic=True)[0]]
    for _ in range(DELAY):
        observation = env.step(np.zeros_like(actions[0]))[0]
    env.close()
    assert observation["delay"] == DELAY
    return [action.tolist() for action in (*actions, run.model.predict(observation, deterministic=True)[0])]


def test_every_agent_is_known_by_its_first_actions() -> None:
    assert AGENTS and set(AGENTS) == set(FIRST_ACTIONS)


@pytest.mark.parametrize("name", AGENTS)
def test_an_agent_loads_by_its_file_alone_and_acts_as_it_did(name: str) -> None:
    file = AGENTS[name]
    assert file.stat().st_size < 8e6
    card = file.with_suffix(".md").read_text()
    assert f'load("{name}")' in card and "library_name: stable-baselines3" in card and "mean_reward" in card
    # Machines round differently; by another plan it would act differently by far more.
    np.testing.assert_allclose(first_actions(file), FIRST_ACTIONS[name], atol=0.05)
    assert hashlib.sha256(file.read_bytes()).hexdigest() in card  # its returns are of this file


def test_one_is_drawn_beside_itself_ignoring_the_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``make demo``, of the first steps of an episode."""
    imageio = pytest.importorskip("imageio.v3")
    need_a_renderer("Hopper-v5", monkeypatch)
    monkeypatch.setattr(gym.spec("Hopper-v5"), "max_episode_steps", 15)
    film = tmp_path / "film.gif"
    words = ["--delay", "8", "--beside-ignorant", "--size", "64", "--fps", "25", "--device", "cpu"]
    enjoy.main([str(FOLDER / "hopper.zip"), *words, "--record", str(film)])
    frames = imageio.imread(film)
    assert frames.shape == (3, 64, 128, 3)  # 125 control steps a second
    assert all(frame.std() > 10 for frame in frames)  # pictures, not blanks
    left, right = np.split(frames.astype(float), 2, axis=2)
    assert np.array_equal(left[0], right[0]) and not np.array_equal(left[-1], right[-1])  # one start, two ways on
