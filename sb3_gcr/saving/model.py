"""Saving, loading, and starting from another model's file, as a base beside PPO's."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv

from sb3_gcr.rewards.spec import RewardSpec
from sb3_gcr.saving.archive import (
    ModelPath,
    SavedModel,
    append_description,
    describe_model,
    missing_attributes,
    read_attributes,
    read_description,
    read_pickled,
    read_plain,
)
from sb3_gcr.saving.checkpoints import saving_path, whole_file
from sb3_gcr.saving.settings import attribute_of, declared, find_settings, refuse_text
from sb3_gcr.saving.spaces import check_spaces
from sb3_gcr.saving.statistics import find_mismatch, restore_statistics
from sb3_gcr.saving.warm_start import merge_parameters

Self = TypeVar("Self", bound="Saving")


class Saving(OnPolicyAlgorithm):
    """Files that are whole, a way to load them without running what they bring, and warm starts.

    A base to put before PPO's: ``class GCRPPO(Saving, MultiHeadPPO)``. What a class keeps beyond
    SB3's attributes it says itself, in the class attributes below; those of all its bases count.
    Settings are the arguments of its constructor.
    """

    #: Attributes that are plain numbers, or lists of them, and in every file.
    saved_numbers: ClassVar[tuple[str, ...]] = ("num_timesteps", "_n_updates")
    #: Attributes that are in no file, because ``_setup_model`` or ``learn`` makes them.
    unsaved: ClassVar[tuple[str, ...]] = ("_waiting_statistics",)
    #: Attributes that follow an argument of the constructor: an argument that is given to ``load``
    #: sets them to None, so that they begin anew.
    followers: ClassVar[tuple[tuple[str, str], ...]] = ()

    #: Names and levels of the reward components.
    reward_spec: RewardSpec
    #: What ``warm_start`` has kept; None for any other model.
    warm_start_report: str | None = None
    #: The statistics of a loaded model whose env has no VecNormalize so far.
    _waiting_statistics: dict[str, Any] | None = None

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
        numbers = declared(type(self), "saved_numbers")
        description = describe_model(self, self.reward_spec, numbers, self._waiting_statistics)
        append_description(file, description)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *declared(type(self), "unsaved")]

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
        :param custom_objects: replace what cannot be unpickled; for ``weights_only`` they are
            arguments like ``kwargs``
        :param print_system_info: print the versions that the model was saved with; without use for
            ``weights_only``
        :param force_reset: reset the env before training
        :param weights_only: unpickle nothing: take the weights, the optimiser's state and the plain
            settings, from tensors and JSON, as ``torch.load(weights_only=True)`` does. Needs
            ``env``. Logs go nowhere until you say where
        :param kwargs: arguments of the constructor that replace the saved ones, and attributes; a
            ``learning_rate`` is the rate of the next step, whatever ``desired_kl`` had made of it
        :return: the model
        :raises ValueError: if components or spaces are not those of the env, or the file cannot be
            read here; with ``weights_only`` if the file needs more, such as a class or function of
            its author's, and the arguments do not give it
        :raises TypeError: for text where a setting is a number
        """
        if isinstance(env, str):
            raise ValueError(
                f"Parameter `env` must be an environment, found the id {env!r}. Make one with "
                "`gymnasium.make` or SB3's `make_vec_env`."
            )
        given = cls._join_given(custom_objects, kwargs)
        if weights_only:
            model = cls._load_plain(path, env, device, given)
        else:
            attributes = read_attributes(path, custom_objects)
            refuse_text(attributes, find_settings(cls), " in the file")
            follows = cls._begin_anew(given)
            changes = {attribute_of(name, attributes): value for name, value in kwargs.items()}
            changes = {**missing_attributes(attributes, cls), **follows, **changes}
            model = super().load(
                path, env, device, attributes, print_system_info, force_reset, **changes
            )
            # Setting the model up has begun some of its numbers anew.
            numbers = set(declared(cls, "saved_numbers")) - changes.keys()
            model.__dict__.update({name: attributes[name] for name in numbers & attributes.keys()})
        model._take_statistics(read_description(path))
        return model

    @classmethod
    def _load_plain(
        cls: type[Self],
        path: ModelPath,
        env: GymEnv | None,
        device: th.device | str,
        given: dict[str, Any],
    ) -> Self:
        """``load(weights_only=True)``."""
        if env is None:
            raise ValueError(
                "Parameter `env` must be an environment for `weights_only=True`, found None."
            )
        settings = find_settings(cls).keys() | {"policy"}
        attributes = {name: given[name] for name in given.keys() - settings}
        given = {name: given[name] for name in given.keys() & settings}
        saved = read_plain(path, device, cls, declared(cls, "saved_numbers"), given)
        model = cls._build(saved, env, device, given)
        model.reward_spec = saved.spec
        model._setup_model()
        model.set_parameters(saved.parameters, exact_match=True, device=device)
        numbers = saved.numbers.keys() - cls._begin_anew(given).keys()
        model.__dict__.update({name: saved.numbers[name] for name in numbers})
        model.__dict__.update(attributes)
        if model.use_sde:
            model.policy.reset_noise()
        return model

    @classmethod
    def _join_given(
        cls, custom_objects: Mapping[str, Any] | None, arguments: Mapping[str, Any]
    ) -> dict[str, Any]:
        """All that the caller has given in place of what the file says."""
        settings = find_settings(cls)
        objects = {
            name: value for name, value in (custom_objects or {}).items() if name in settings
        }
        given = {**objects, **arguments}
        refuse_text(given, settings)
        return given

    @classmethod
    def _begin_anew(cls, given: Mapping[str, Any]) -> dict[str, None]:
        """The attributes that follow an argument which the caller has given, without a value."""
        followers = declared(cls, "followers")
        return {attribute: None for attribute, argument in followers if argument in given}

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
        :param custom_objects: as for ``load``
        :param weights_only: unpickle nothing, as for ``load``; not for files of SB3's PPO
        :param kwargs: arguments of the constructor that replace the old ones; a critic of other
            sizes begins anew
        :return: the new model
        :raises ValueError: if spaces or actor differ, and says in what
        """
        given = cls._join_given(custom_objects, kwargs)
        if weights_only:
            saved = read_plain(path, device, cls, declared(cls, "saved_numbers"), given)
        else:
            saved = read_pickled(path, device, cls, custom_objects)
        model = cls._build(saved, env, device, given)
        model._setup_model()
        parameters, kept = merge_parameters(
            model.policy.state_dict(),
            saved.parameters["policy"],
            model.reward_spec.names,
            saved.spec.names,
            model.policy.share_features_extractor,
        )
        model.policy.load_state_dict(parameters)
        restored = model._take_statistics(read_description(path), returns=bool(kept.kept))
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
            check_spaces(saved.spaces, env.observation_space, env.action_space)
        model = cls(env=env, device=device, _init_setup_model=False, **arguments)
        check_spaces(saved.spaces, model.observation_space, model.action_space)
        return model

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """SB3's ``set_env``; the reward components must be those of the model, their order may
        differ.

        A VecNormalize that has not seen anything yet gets the statistics of a model that was loaded
        without one.

        :param env: the environment to learn from
        :param force_reset: reset it before training
        :raises ValueError: if the names of the components differ
        """
        super().set_env(env, force_reset)
        if self._waiting_statistics is not None:
            self._take_statistics({"vec_normalize": self._waiting_statistics})

    def _take_statistics(self, description: Mapping[str, Any] | None, returns: bool = True) -> str:
        """Give a file's statistics to VecNormalize where that has none, and say so; warn if the
        two do not fit.

        :param description: of the file, None where it has none
        :param returns: whether to restore those of the returns, too
        """
        saved = description["vec_normalize"] if description else None
        vec_normalize = self.get_vec_normalize_env()
        mismatch = find_mismatch(vec_normalize, saved) if description and self.env else None
        if mismatch:
            warnings.warn(mismatch, stacklevel=3)
        self._waiting_statistics = saved if vec_normalize is None else None
        return restore_statistics(vec_normalize, saved, returns)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(*args, **kwargs)
        self._waiting_statistics = None  # from here on it learns without
        if self.warm_start_report is not None:
            self.logger.info(self.warm_start_report)
        return result
