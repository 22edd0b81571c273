"""Running a cell: train, evaluate, and say under which circumstances."""

from __future__ import annotations

import math
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gcr.gcrppo import GCRPPO
from sb3_gcr.multi_head import find_kind
from sb3_gcr.resolvers import RESOLVERS
from sb3_gcr.rewards.reading import find_reward_spec
from sb3_gcr.rewards.spec import RewardSpec
from sb3_gcr.study.environments import Shown, make_envs, no_components_message
from sb3_gcr.study.manifest import cell_id
from sb3_gcr.study.methods import trained_spec
from sb3_gcr.study.provenance import provenance
from sb3_gcr.study.settings import MODEL, OURS, policy_kwargs
from sb3_gcr.study.store import SCHEMA, plain
from sb3_gcr.study.watching import (
    WINDOWS,
    Episode,
    Recorder,
    Update,
    WatchedResolver,
    finished,
    over_windows,
)
from sb3_gcr.update import ConflictResolution

#: Deterministic episodes of the trained policy, and episodes of random actions.
EVALUATION_EPISODES, RANDOM_EPISODES = 64, 16
#: Seeds of the envs of two runs lie so far apart that no two envs have the same.
SEED_STRIDE, EVALUATION_OFFSET, RANDOM_OFFSET = 10_000, 5_000, 7_000

Fields = Mapping[str, Any]


class RandomPolicy:
    """Draws actions from the action space.

    :param envs: whose action space, and how many
    :param seed: of the draws
    """

    def __init__(self, envs: VecEnv, seed: int):
        self.space, self.n_envs = envs.action_space, envs.num_envs
        self.space.seed(seed)

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> tuple[Any, None]:
        """An action for each env."""
        return np.array([self.space.sample() for _ in range(self.n_envs)]), None


def run_cell(cell: Fields, threads: int = 1) -> dict[str, Any]:
    """Train and evaluate one cell on the CPU.

    :param cell: canonical
    :param threads: of PyTorch and of envs that have their own
    :return: the content of ``result.json``
    :raises ValueError: if the env has no terms, or a number is not finite
    """
    th.set_num_threads(threads)
    started, wall, cpu = time.time(), time.perf_counter(), time.process_time()
    envs = training_envs(cell, threads)
    spec = spec_of(envs, cell)
    training = normalised(envs, cell)
    resolver = WatchedResolver(RESOLVERS[cell["algorithm"]["resolver"]])
    intended = trained_spec(cell["algorithm"], spec)
    model = make_model(cell, Shown(training, intended), resolver)
    assert model.reward_spec == intended, f"{model.reward_spec} is not {intended}"
    recorder = Recorder(spec.names, resolver, whole_rollouts(cell))
    model.learn(cell["timesteps"], callback=recorder)
    trained = time.perf_counter()
    final = _evaluate(cell, model, training, spec, threads)
    at_random = _evaluate_random(cell, spec, threads)
    training.close()
    times = {
        "steps": model.num_timesteps,
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "collect_s": recorder.collect_s,
        "update_s": recorder.update_s,
        "evaluate_s": time.perf_counter() - trained,
        "memory_mb": _memory(),
    }
    curves = _curves(recorder, spec, model.reward_spec)
    scalars = _scalars(recorder, curves, model.reward_spec, final, at_random)
    result = {
        "schema": SCHEMA,
        "id": cell_id(cell),
        "cell": cell,
        "scalars": scalars | times,
        "final_terms": _by_name(spec, np.mean([one.terms for one in final], axis=0)),
        "curves": curves,
        "levels": levels_of(cell["algorithm"], spec),
        "cosines": _cosines(recorder.updates, model.reward_spec),
        "provenance": provenance(started, threads),
    }
    done: dict[str, Any] = plain(result)
    return done


def training_envs(cell: Fields, threads: int) -> VecEnv:
    """The envs that a cell trains on.

    :param cell: canonical
    :param threads: of envs that have their own
    """
    return make_envs(cell, cell["settings"]["n_envs"], SEED_STRIDE * cell["seed"], threads)


def spec_of(envs: VecEnv, cell: Fields) -> RewardSpec:
    """What the envs say of their terms.

    :param envs: of the cell
    :param cell: canonical
    :raises ValueError: if they say nothing
    """
    spec = find_reward_spec(envs)
    if spec is None:
        raise ValueError(f"'{cell['env']}': {no_components_message({})}")
    return spec


def levels_of(method: Fields, spec: RewardSpec) -> dict[str, int]:
    """The level of each term that the update used; of a summed reward the env's.

    :param method: fields of a Method
    :param spec: what the env says
    """
    return spec.to_dict() if method["summed"] else trained_spec(method, spec).to_dict()


def normalised(envs: VecEnv, cell: Fields) -> VecEnv:
    """The same envs in VecNormalize, as the settings have it.

    :param envs: of the cell
    :param cell: canonical
    """
    settings = cell["settings"]
    if not settings["normalize_obs"] and not settings["normalize_reward"]:
        return envs
    return VecNormalize(
        envs,
        norm_obs=settings["normalize_obs"],
        norm_reward=settings["normalize_reward"],
        clip_obs=settings["clip_obs"],
        clip_reward=settings["clip_reward"],
        gamma=settings["gamma"],
    )


def algorithm_for(policy: str) -> Any:
    """GCRPPO, or RecurrentGCRPPO for a policy with an LSTM.

    :param policy: name of the policy
    """
    if find_kind(policy) != "recurrent":
        return GCRPPO
    from sb3_gcr.recurrent import RecurrentGCRPPO  # an extra

    return RecurrentGCRPPO


def make_model(cell: Fields, envs: VecEnv, resolver: WatchedResolver) -> ConflictResolution:
    """The model of a cell.

    :param cell: canonical
    :param envs: to train on
    :param resolver: of the cell's method
    """
    settings = cell["settings"] | cell["algorithm"]["overrides"]
    return algorithm_for(settings["policy"])(
        settings["policy"],
        envs,
        **{name: settings[name] for name in (*MODEL, *OURS)},
        policy_kwargs=policy_kwargs(settings),
        seed=SEED_STRIDE * cell["seed"],
        device="cpu",
        resolver=resolver,
        resolver_kwargs=cell["algorithm"]["resolver_kwargs"],
    )


def whole_rollouts(cell: Fields) -> int:
    """Steps that a training takes, which ends with a rollout.

    :param cell: canonical
    """
    rollout = cell["settings"]["n_envs"] * cell["settings"]["n_steps"]
    return math.ceil(cell["timesteps"] / rollout) * rollout


def _evaluate(
    cell: Fields, model: ConflictResolution, training: VecEnv, spec: RewardSpec, threads: int
) -> list[Episode]:
    """Deterministic episodes of the trained policy."""
    seed = SEED_STRIDE * cell["seed"] + EVALUATION_OFFSET
    envs = make_envs(cell, _n_envs(cell, EVALUATION_EPISODES), seed, threads)
    if isinstance(training, VecNormalize):
        envs = VecNormalize(envs, False, training.norm_obs, False, training.clip_obs)
        envs.obs_rms = training.obs_rms
    return _episodes(model, envs, spec, EVALUATION_EPISODES)


def _evaluate_random(cell: Fields, spec: RewardSpec, threads: int) -> list[Episode]:
    """Episodes of random actions."""
    seed = SEED_STRIDE * cell["seed"] + RANDOM_OFFSET
    envs = make_envs(cell, _n_envs(cell, RANDOM_EPISODES), seed, threads)
    return _episodes(RandomPolicy(envs, seed), envs, spec, RANDOM_EPISODES)


def _n_envs(cell: Fields, episodes: int) -> int:
    """An episode an env where a thread pool steps them, else the training's number."""
    is_pool = cell["env"].startswith(("sb3_gcr/", "envpool/"))
    return episodes if is_pool else min(episodes, cell["settings"]["n_envs"])


def _episodes(
    policy: PolicyPredictor, envs: VecEnv, spec: RewardSpec, number: int
) -> list[Episode]:
    keys = [f"r_{name}" for name in spec.names]
    episodes: list[Episode] = []

    def keep(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"]:
            episodes.append(finished(local["info"], keys, 0))

    evaluate_policy(policy, envs, number, callback=keep, warn=False)
    envs.close()
    return episodes


def _curves(recorder: Recorder, spec: RewardSpec, trained: RewardSpec) -> dict[str, Any]:
    """Everything over the windows of the training."""
    total = recorder.total
    ended = recorder.episodes
    steps = [episode.steps for episode in ended]
    terms = over_windows(steps, np.array([one.terms for one in ended]), total)
    curves = {
        "steps": [round(total * (window + 1) / WINDOWS) for window in range(WINDOWS)],
        "return": over_windows(steps, np.array([one.total for one in ended]), total),
        "terms": _columns(terms, spec),
    }
    when = [update.steps for update in recorder.updates]
    if not when:
        return curves | {"conflicts": None, "conflict_rate": None, "weights": None}
    found = np.array([update.conflicts for update in recorder.updates])
    weights = over_windows(when, np.array([one.weights for one in recorder.updates]), total)
    return curves | {
        "conflicts": over_windows(when, found, total),
        "conflict_rate": over_windows(when, found / _n_pairs(trained), total),
        "weights": _columns(weights, trained),
    }


def _columns(windows: Sequence[Any], spec: RewardSpec) -> dict[str, list[Any]]:
    """One curve a name, of windows that hold a number a name or nothing."""
    return {
        name: [None if window is None else window[column] for window in windows]
        for column, name in enumerate(spec.names)
    }


def _scalars(
    recorder: Recorder,
    curves: Fields,
    trained: RewardSpec,
    final: Sequence[Episode],
    at_random: Sequence[Episode],
) -> dict[str, Any]:
    returns = [one.total for one in final]
    windows = [value for value in curves["return"] if value is not None]
    updates = recorder.updates
    found = np.mean([update.conflicts for update in updates]) if updates else None
    return {
        "return_training": np.mean(windows) if windows else None,
        "return_final": np.mean(returns),
        "return_final_std": np.std(returns),
        "random_return": np.mean([one.total for one in at_random]),
        "conflict_count": found,
        "conflict_rate": None if found is None else found / _n_pairs(trained),
        "failed_share": np.mean([one.was_terminated for one in final]),
        "dominance_share": np.mean([one.dominance for one in updates]) if updates else None,
    }


def _cosines(updates: Sequence[Update], spec: RewardSpec) -> dict[str, Any] | None:
    """Mean cosines of the first and the last tenth of the updates."""
    if not updates:
        return None
    tenth = max(1, len(updates) // 10)
    return {
        "names": list(spec.names),
        "first": np.mean([one.cosines for one in updates[:tenth]], axis=0),
        "last": np.mean([one.cosines for one in updates[-tenth:]], axis=0),
        "kind": "minibatch",
    }


def _by_name(spec: RewardSpec, values: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip(spec.names, values.tolist(), strict=True))


def _n_pairs(spec: RewardSpec) -> int:
    return max(1, len(spec) * (len(spec) - 1) // 2)


def _memory() -> float:
    """Largest resident memory of this process [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)
