"""PPO on reward vectors that can be saved, loaded and started from another model's file."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv

from sb3_gcr.multi_head_ppo import MultiHeadPPO
from sb3_gcr.saving.archive import (
    ModelPath,
    SavedModel,
    append_description,
    check_spaces,
    describe_model,
    read_pickled,
    read_plain,
    read_statistics,
)
from sb3_gcr.saving.checkpoints import saving_path, whole_file
from sb3_gcr.saving.statistics import restore_statistics
from sb3_gcr.saving.warm_start import merge_parameters

Self = TypeVar("Self", bound="PersistentPPO")


class PersistentPPO(MultiHeadPPO):
    """``MultiHeadPPO`` with files that are whole, a way to load them without running what they bring,
    and warm starts.

    :param args: the arguments of SB3's PPO
    :param kwargs: the keyword arguments of SB3's PPO
    """

    #: What ``warm_start`` has kept; None for any other model.
    warm_start_report: str | None = None

    def save(
        self,
        path: ModelPath,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """SB3's ``save``, but whole: a crash leaves the file that was there before or the new one,
        never half of one.

        The file is SB3's, which ``load`` and SB3's own tools read, with one more entry,
        ``sb3_gcr.json``: the statistics of VecNormalize at this moment, and all plain settings.
        SB3's ``CheckpointCallback`` and ``EvalCallback`` call this method, so their files are
        whole, too; see :func:`~sb3_gcr.latest_checkpoint` for how to go on from them.

        :param path: file, ".zip" is added where it has no suffix; or a stream, which is written in
            one go
        :param exclude: attributes to leave out
        :param include: attributes to save though they are usually left out
        """
        if isinstance(path, str | Path):
            with whole_file(saving_path(path)) as file:
                self._save_to(file, exclude, include)
            return
        stream = open_path(path, "w")
        buffer = io.BytesIO()
        self._save_to(buffer, exclude, include)
        stream.write(buffer.getbuffer())

    def _save_to(
        self,
        file: io.BytesIO | io.BufferedRandom,
        exclude: Iterable[str] | None,
        include: Iterable[str] | None,
    ) -> None:
        super().save(file, exclude, include)
        append_description(file, describe_model(self, self.reward_spec))

    @classmethod
    def load(
        cls: type[Self],
        path: ModelPath,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        weights_only: bool = False,
        **kwargs: Any,
    ) -> Self:
        """SB3's ``load``, with the statistics of VecNormalize, and a way for files of people that
        you do not know.

        .. warning::

            As in SB3, loading a model runs the code that is pickled in its file: whoever made the
            file can do with your computer what you can do. Load only what you trust, or set
            ``weights_only=True``.

        If ``env`` has a VecNormalize that has not seen anything yet, it gets the saved statistics;
        one that has been reset or stepped, or loaded, keeps its own.

        :param path: file of ``save``, with or without ".zip", or a stream
        :param env: the env to go on with; its reward components must be those of the model
        :param device: where the model goes
        :param custom_objects: replace what cannot be unpickled; without use for ``weights_only``
        :param print_system_info: print the versions that the model was saved with; without use for
            ``weights_only``
        :param force_reset: reset the env before training
        :param weights_only: unpickle nothing: take the weights, the optimiser's state and the plain
            settings, from tensors and JSON, as ``torch.load(weights_only=True)`` does. Needs
            ``env``. Logs go nowhere until you say where
        :param kwargs: arguments of the constructor that replace the saved ones
        :return: the model
        :raises ValueError: if components or spaces are not those of the env; with ``weights_only``
            if the file needs more, such as a class or function of its author's, and the arguments
            do not give it
        """
        if not weights_only:
            model = super().load(
                path, env, device, custom_objects, print_system_info, force_reset, **kwargs
            )
            model._restore_statistics(None if env is None else read_statistics(path))
            return model
        if env is None:
            raise ValueError(
                "Parameter `env` must be an environment for `weights_only=True`, found None."
            )
        saved = read_plain(path, device, kwargs)
        model = cls._build(saved, env, device, kwargs)
        model.reward_spec = saved.spec
        model._setup_model()
        model.set_parameters(saved.parameters, exact_match=True, device=device)
        model.__dict__.update(saved.counters)
        model._restore_statistics(saved.statistics)
        if model.use_sde:
            model.policy.reset_noise()
        return model

    @classmethod
    def warm_start(
        cls: type[Self],
        path: ModelPath,
        env: GymEnv | str,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        weights_only: bool = False,
        **kwargs: Any,
    ) -> Self:
        """A new model that begins with what another one, a GCRPPO or a PPO, has learned of other
        reward terms.

        Kept are the settings, the actor with its standard deviation, shared layers, the critic's
        hidden layers, and the value heads of components that have the same name; PPO's one head, of
        the summed reward, fits none of several. New are the other heads, the optimiser's state and
        all counters. A VecNormalize of ``env`` that has not seen anything yet gets the saved
        statistics, those of the returns only if a head was kept. ``warm_start_report`` says what
        was kept, and ``learn`` logs it.

        .. warning::

            As in SB3, reading a model runs the code that is pickled in its file; see
            ``weights_only``.

        :param path: file of the old model, which may be SB3's PPO
        :param env: with the same spaces; its reward components may be others
        :param device: where the model goes
        :param custom_objects: replace what cannot be unpickled
        :param weights_only: unpickle nothing, as for ``load``; not for files of SB3's PPO
        :param kwargs: arguments of the constructor that replace the old ones; a critic of other
            sizes begins anew
        :return: the new model
        :raises ValueError: if spaces or actor differ, and says in what
        """
        saved = (
            read_plain(path, device, kwargs)
            if weights_only
            else read_pickled(path, device, custom_objects)
        )
        model = cls._build(saved, env, device, kwargs)
        model._setup_model()
        parameters, kept = merge_parameters(
            model.policy.state_dict(),
            saved.parameters["policy"],
            model.reward_spec.names,
            saved.spec.names,
            model.policy.share_features_extractor,
        )
        model.policy.load_state_dict(parameters)
        restored = model._restore_statistics(saved.statistics, returns=bool(kept.kept))
        model.warm_start_report = kept.report(path, restored)
        if model.use_sde:
            model.policy.reset_noise()
        return model

    @classmethod
    def _build(
        cls: type[Self],
        saved: SavedModel,
        env: GymEnv | str,
        device: th.device | str,
        given: dict[str, Any],
    ) -> Self:
        """A model with the settings of a file on another env, before its networks are made."""
        arguments = {"policy": saved.policy, **saved.settings, **given}
        if not isinstance(env, str):  # before SB3 says that the policy does not fit
            env = cls._wrap_env(env)
            check_spaces(saved, env.observation_space, env.action_space)
        model = cls(env=env, device=device, _init_setup_model=False, **arguments)
        check_spaces(saved, model.observation_space, model.action_space)
        return model

    def _restore_statistics(self, saved: dict[str, Any] | None, returns: bool = True) -> str:
        """Give saved statistics to VecNormalize where that has none, and say so."""
        vec_normalize = self.get_vec_normalize_env()
        if saved is None or vec_normalize is None:
            if saved is None:
                return "VecNormalize: no statistics in the file"
            return "VecNormalize: none, though the file has statistics"
        if not restore_statistics(vec_normalize, saved, returns):
            return "VecNormalize keeps its own statistics"
        return f"VecNormalize's statistics of observations{' and returns' if returns else ''} kept"

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(*args, **kwargs)
        if self.warm_start_report is not None:
            self.logger.info(self.warm_start_report)
        return result
