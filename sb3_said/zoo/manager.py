"""A run from its first step to its saved agent: callbacks, checkpoints, resume, logs."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_said import SAID, DelayedSAC, PlannerTrainingCallback
from sb3_said.files.archive import SavedFileError
from sb3_said.files.atomic import write_json, write_text
from sb3_said.files.checkpoint import TrainingCheckpointCallback, restore_training
from sb3_said.files.normalization import normalization_file, save_normalization
from sb3_said.planner.config import SAMPLING_SETTINGS
from sb3_said.zoo.answer import (
    BEST_NAME,
    EXPERT_FOLDER,
    StoppableEvaluation,
    evaluate_answer,
    save_with_normalization,
)
from sb3_said.zoo.arguments import ending_training
from sb3_said.zoo.experiment import DelayedExperiment
from sb3_said.zoo.folder import drop_undone_episodes, log_suffix, resuming
from sb3_said.zoo.record import ENDED_NAME


class DelayedExperimentManager(DelayedExperiment):
    """rl_zoo3's manager with delays, presets and resumable runs.

    The parameters are those of :class:`DelayedExperiment`.
    """

    LOG_INTERVAL = 4  # episodes
    evaluation: StoppableEvaluation | None = None

    def create_callbacks(self) -> None:
        super().create_callbacks()
        of_zoo = next((c for c in self.callbacks if isinstance(c, EvalCallback)), None)
        if of_zoo is not None:
            folder = self._evaluated_in()
            own = of_zoo.callback_on_new_best  # of rl_zoo3, for its own tools
            assert own is not None
            self.evaluation = StoppableEvaluation(
                of_zoo.eval_env,
                self.stopping,
                callback_on_new_best=CallbackList([own, SaveNormalization(normalization_file(folder / BEST_NAME))]),
                n_eval_episodes=of_zoo.n_eval_episodes,
                eval_freq=of_zoo.eval_freq,
                log_path=str(folder),
                best_model_save_path=str(folder),
                deterministic=of_zoo.deterministic,
            )
            self.callbacks[self.callbacks.index(of_zoo)] = self.evaluation
        self._add_checkpoints()

    def _evaluated_in(self) -> Path:
        """Return the folder for evaluations during training. In SAID it is the expert that learns then."""
        return self.folder / EXPERT_FOLDER if self.algo == "said" else self.folder

    def _add_checkpoints(self) -> None:
        self.checkpointing = TrainingCheckpointCallback(self.folder, self.run.checkpoint_freq, self.stopping)
        self.callbacks.append(self.checkpointing)
        if self.algo == "said":
            how: dict[str, Any] = {"progress_bar": self.show_progress, "should_stop": self.stopping}
            if self.evaluation is not None:  # else the training's may be the only environment, as on a robot
                how["make_trial_env"] = partial(self.create_envs, no_log=True)
            self.callbacks.append(PlannerTrainingCallback(self.folder, **how))

    def learn(self, model: BaseAlgorithm) -> None:
        """Train, from the last checkpoint if there is one. Ctrl-C, SIGTERM or SIGHUP ends it with a checkpoint.

        :param model: newly made
        :raises SystemExit: for a checkpoint that is damaged, or of another training
        """
        resumes, ended = self.checkpoint.exists(), self.folder / ENDED_NAME
        had_ended = ended.read_text() if ended.is_file() else None
        if resumes:
            with ending_training(SavedFileError):
                callbacks = CallbackList(self.callbacks)
                restore_training(model, self.checkpoint, callbacks)  # type: ignore[arg-type]  # one of ALGORITHMS
            with ending_training(ValueError):
                self._check_more_steps(model.num_timesteps)
                if isinstance(model, SAID) and model.policy.planner_is_trained:  # an untrained one is made as asked
                    # Where a trial chooses among ways, the settings that the run began with must not undo its choice
                    asked = self._given if model.planner_ways else self.custom_hyperparams or {}
                    _decide_as_given(model, asked.get("planner_kwargs", {}))
            print(f"Resuming {self.save_path} at step {model.num_timesteps}")
            drop_undone_episodes(self.checkpoint)
        if self.run.record is not None:
            self._write_config()
        ended.unlink(missing_ok=True)
        taken = model.num_timesteps if resumes else 0  # learn() counts the steps of an agent given with -i anew
        model.set_logger(self._logger(taken))
        # rl_zoo3: -1 is the default, anything below logs nothing by itself
        log_interval = {-1: self.LOG_INTERVAL}.get(self.log_interval, max(self.log_interval, 0) or None)
        how = {"callback": self.callbacks, "log_interval": log_interval, "reset_num_timesteps": not resumes}
        try:
            with self.stopping.listening(), ending_training(SavedFileError):  # of the planner's checkpoint
                self._learn(model, max(self.n_timesteps - taken, 0), **how)
                if self.stopping.is_asked:
                    raise KeyboardInterrupt
        except SystemExit:
            if self.run.record is not None:  # the planner's checkpoint still has these settings
                self.run.record.write(self.folder)
            if had_ended is not None:
                write_text(ended, had_ended)
            raise
        except KeyboardInterrupt:
            self.stopping.is_asked = True
            written = not self.stopping.is_forced and self._save_checkpoint(model)
            state = "and wrote a checkpoint" if written else "without a checkpoint of this step"
            print(f"Interrupted at step {model.num_timesteps} {state}; go on with {resuming(self.folder)}")
        except Exception:
            print(f"Stopped at step {model.num_timesteps} by an error; {resuming(self.folder)} goes on from the "
                  "last checkpoint, or begins again where there is none.")  # fmt: skip
            raise
        finally:
            with suppress(EOFError, ConnectionError):  # of processes that have ended already
                if model.env is not None:
                    model.env.close()

    def _check_more_steps(self, taken: int) -> None:
        """
        :raises ValueError: for a -n below the steps that the run has taken: no record should say so
        """
        record = self.run.record
        assert record is not None  # only a resumed run has a checkpoint
        if self.n_timesteps < min(taken, record.n_timesteps or taken):
            raise ValueError(
                f"{self.save_path} has taken {taken} steps: give -n more than that, or leave it out, got "
                f"{self.n_timesteps}."
            )

    def _learn(self, model: Any, steps: int, **how: Any) -> None:
        """Learn for ``steps`` steps. Then evaluate a SAID agent as it answers, once its planner is trained."""
        model.learn(steps, **how)
        is_answer = isinstance(model, SAID) and model.policy.planner_is_trained
        if is_answer and self.evaluation is not None and not self.stopping.is_asked:
            if self.run.expert_delay is not None:
                self.evaluation.eval_env.close()
                self._under_expert_delay = False
                self.evaluation.eval_env = self.create_envs(self.n_eval_envs, eval_env=True)
            evaluate_answer(model, self.evaluation, self.folder, self.stopping)

    def _save_checkpoint(self, model: Any) -> bool:
        """Write a checkpoint when the training is asked to stop; return whether the file holds all of it."""
        return self.checkpointing.save()

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """Save as rl_zoo3 does, but without pickle. The suffix .zip is added even if the task's name has a dot."""
        assert isinstance(model, DelayedSAC)
        model.task = self.env_name.gym_id  # environments in other processes do not tell it
        file = self.folder / f"{self.env_name}.zip"
        is_unfinished = self.stopping.is_asked and isinstance(model, SAID) and not model.planner_is_current
        if is_unfinished and _is_whole(file):  # from before the run was trained for longer
            print(f"{file} stays as it was, with its planner.")
            return
        print(f"Saving to {self.save_path}")
        save_with_normalization(model, file)
        if self.save_replay_buffer:
            model.save_replay_buffer(self.folder / "replay_buffer.pkl")
        if (vec_normalize := model.get_vec_normalize_env()) is not None:
            vec_normalize.save(str(Path(self.params_path, "vecnormalize.pkl")))  # for rl_zoo3's own tools
        if not self.stopping.is_asked:
            write_json(self.folder / ENDED_NAME, {"trained_steps": model.num_timesteps})

    def _logger(self, steps: int) -> Logger:
        """Log to the screen, to progress.csv (one file per resume) and to TensorBoard if asked for.

        :param steps: environment steps the run has taken
        """
        formats = [make_output_format("csv", self.save_path, log_suffix(self.folder, steps))]
        if self.verbose > 0:
            formats.append(make_output_format("stdout", self.save_path))
        if self.tensorboard_log is not None:
            board = Path(self.tensorboard_log, self.algo, self.folder.resolve().name)
            formats.append(make_output_format("tensorboard", str(board)))
        return Logger(self.save_path, formats)


class SaveNormalization(BaseCallback):
    """Write what VecNormalize has learned, beside the agent that reads it.

    :param path: of the file
    """

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        if (vec_normalize := self.model.get_vec_normalize_env()) is not None:
            save_normalization(self.path, vec_normalize)
        return True


def _decide_as_given(model: SAID, given: dict[str, Any]) -> None:
    """Let a command's settings of how to decide replace the checkpoint's. The planner itself stays.

    :raises ValueError: for the ``mask`` of another planner
    """
    own = model.planner_kwargs["mask"]
    if given.get("mask", own) != own:
        raise ValueError(f"--resume goes on with mask={own!r}, as its planner was trained, got {given['mask']!r}.")
    model.set_planner(**{name: value for name, value in given.items() if name in SAMPLING_SETTINGS})


def _is_whole(file: Path) -> bool:
    """Tell whether a file holds an agent with its current planner."""
    try:
        return file.is_file() and SAID.load(file, device="cpu").planner_is_current
    except SavedFileError:
        return False
