"""An exported student answers as the agent does, to float32's precision, and runs a loop without PyTorch."""

import subprocess
import sys

import numpy as np
import pytest
from gymnasium import spaces
from small_agent import make, observe, teach
from small_task import Drift, delayed
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_said import SAID, DelayedObservationWrapper
from sb3_said.realtime import ControlLoop, OnnxModel
from sb3_said.said.export import export

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


class Uneven(Drift):
    action_space = spaces.Box(np.float32([-2.0]), np.float32([0.5]))


@pytest.mark.parametrize("max_delay", [2, 0, None])
def test_it_answers_as_the_agent(max_delay, tmp_path):
    env = Uneven() if max_delay is None else delayed(max_delay)
    model = make(env)
    set_random_seed(0)
    model.policy.make_student(16)
    student = model.policy.student
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(7, 2)).astype(np.float32) if max_delay is None else observe(env=env)
    if max_delay:  # what is older than an observation is not to be read
        obs["delay"][:, 0], obs["action_history"] = np.arange(7) % 3, rng.uniform(-1, 1, (7, 2, 1)).astype(np.float32)
        assert (obs["action_history"][obs["delay"][:, 0] == 0] != 0).all()
    student.scale_to(student.read(model.policy.obs_to_tensor(obs)[0]))
    for layer in student.network[::2]:
        layer.weight.data *= 2
    export(model, tmp_path / "agent.onnx")
    loaded = OnnxModel(tmp_path / "agent.onnx")
    with model.policy.answering("student"):
        wanted = model.predict(obs, deterministic=True)[0]
    assert wanted.std() > 0.1
    np.testing.assert_allclose(loaded.predict(obs)[0], wanted, rtol=1e-5, atol=1e-6)
    assert loaded.action_space == model.action_space
    assert loaded.observation_space == model.observation_space


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float64])
def test_a_loop_of_it_sends_actions_of_the_agents_kind(dtype, tmp_path):
    class Levels(Drift):
        action_space = spaces.Box(0, 200, (1,), dtype)

    model = teach(make(DelayedObservationWrapper(Levels(), delay=2)))
    export(model, tmp_path / "agent.onnx")
    loaded = OnnxModel(tmp_path / "agent.onnx")
    assert (loaded.action_space, loaded.observation_space) == (model.action_space, model.observation_space)
    loops = [ControlLoop(each, 1, simulate=lambda seconds: 0) for each in (loaded, model)]
    with model.policy.answering("student"):
        for loop in loops:
            loop.observe(np.ones(2), n_executed=0)
        own, wanted = (loop.act(0) for loop in loops)
        answers = [each.predict(observe(), deterministic=True)[0] for each in (loaded, model)]
    assert own.dtype == wanted.dtype == dtype
    np.testing.assert_allclose(own, wanted, rtol=1e-5)
    assert answers[0].dtype == answers[1].dtype == dtype
    np.testing.assert_allclose(*answers, rtol=1e-5)
    given = {key: part.astype(np.float32) for key, part in observe().items()}
    session = loaded._session.run(["action"], given)[0]  # by who reads the file without us
    np.testing.assert_allclose(session, answers[1], rtol=1e-5)


@pytest.mark.parametrize("make_env", [delayed, Drift])
def test_it_has_the_scale_of_normalised_observations_where_that_is_known(make_env, tmp_path):
    keys = ["observation"] if make_env is delayed else None
    venv = VecNormalize(DummyVecEnv([make_env]), norm_obs_keys=keys, clip_obs=1.5)
    model, obs = teach(make(venv)), observe()
    obs = obs if make_env is delayed else obs["observation"]
    seen = venv.obs_rms["observation"] if make_env is delayed else venv.obs_rms
    seen.mean, seen.var = np.array([0.5, -0.3]), np.array([0.04, 2.0])
    export(model, tmp_path / "agent.onnx")
    loaded, scaled = OnnxModel(tmp_path / "agent.onnx"), venv.normalize_obs(obs)
    assert (np.abs(scaled["observation"] if make_env is delayed else scaled) == 1.5).any()
    with model.policy.answering("student"):
        wanted = model.predict(scaled, deterministic=True)[0]
    np.testing.assert_allclose(loaded.predict(obs)[0], wanted, rtol=1e-5, atol=1e-6)
    ControlLoop(loaded, 1)
    model.save(tmp_path / "agent.zip")
    export(SAID.load(tmp_path / "agent.zip", device="cpu"), tmp_path / "alone.onnx")
    with pytest.raises(ValueError, match=r"give normalize=venv\.normalize_obs"):
        ControlLoop(OnnxModel(tmp_path / "alone.onnx"), 1)


def test_an_answer_that_is_not_finite_is_refused(tmp_path):
    model = teach(make())
    model.policy.student.network[-2].bias.data.fill_(np.nan)
    export(model, tmp_path / "agent.onnx")
    with pytest.raises(ValueError, match="not finite; look at the observation"):
        OnnxModel(tmp_path / "agent.onnx").predict(observe())


def test_it_answers_and_refuses_what_the_agent_does(tmp_path):
    model = teach(make())
    export(model, tmp_path / "agent.onnx")
    loaded, obs = OnnxModel(tmp_path / "agent.onnx"), observe()
    one = {key: part[0] for key, part in obs.items()}
    np.testing.assert_array_equal(loaded.predict(one)[0], loaded.predict(obs)[0][0])
    for key, value in (("delay", 3), ("delay", -1), ("delay", 0.5), ("action_history", 5), ("observation", np.nan)):
        wrong = {**obs, key: np.full_like(obs[key], value)}
        refused = []
        for who in (loaded, model):
            with pytest.raises(ValueError) as error:
                who.predict(wrong)
            refused.append(str(error.value))
        assert refused[0] == refused[1]
    with pytest.raises(ValueError, match="got ndarray"):
        loaded.predict(obs["observation"])


def test_it_plays_where_its_agent_does_with_a_state_history_that_it_does_not_read(tmp_path):
    env = DelayedObservationWrapper(Drift(), (0, 2), state_history=True)
    model = teach(make(env, planner_kwargs={"extra_state_probability": 0.5}))
    export(model, tmp_path / "agent.onnx")
    obs = observe(env=env)
    with model.policy.answering("student"):
        wanted = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(OnnxModel(tmp_path / "agent.onnx").predict(obs)[0], wanted, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match=r"wrap the task in DelayedObservationWrapper\(\.\.\., state_history=False\)"):
        make().predict(obs)


def test_a_file_of_another_program_is_told(tmp_path):
    model = teach(make())
    export(model, tmp_path / "agent.onnx")
    graph = onnx.load(tmp_path / "agent.onnx")
    del graph.metadata_props[:]
    onnx.save(graph, tmp_path / "other.onnx")
    (tmp_path / "damaged.onnx").write_bytes(b"nonsense")
    for name in ("other", "damaged"):
        with pytest.raises(ValueError, match=rf"{name}.onnx is no file of sb3-said export, or damaged"):
            OnnxModel(tmp_path / f"{name}.onnx")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        OnnxModel(tmp_path / "nowhere.onnx")


def test_a_loop_runs_it_without_pytorch(tmp_path):
    model = teach(make())
    export(model, tmp_path / "agent.onnx")
    code = f"""
import sys, numpy as np
from sb3_said.realtime import ControlLoop, OnnxModel
loop = ControlLoop(OnnxModel({str(tmp_path / "agent.onnx")!r}), 1, simulate=lambda seconds: 0)
loop.observe(np.ones(2), n_executed=0)
print(loop.act(0)[0], *{{"torch", "stable_baselines3"}} & sys.modules.keys())
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    obs = {"observation": np.ones(2), "action_history": np.zeros((2, 1)), "delay": np.zeros(1)}
    with model.policy.answering("student"):
        assert float(done.stdout) == pytest.approx(model.predict(obs, deterministic=True)[0][0], rel=1e-5)


def test_without_a_student_there_is_nothing_to_export(tmp_path):
    for model in (make(), make(student_width=16)):  # which is not taught yet
        with pytest.raises(ValueError, match=r"no student to export.*model.distill\(\)"):
            export(model, tmp_path / "agent.onnx")
    assert not any(tmp_path.iterdir())
