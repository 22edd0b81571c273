"""Verdicts, and every sentence of an answer. Pure: numbers in, words out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

from sb3_gcr.study.contrasts import MARGIN, Contrast
from sb3_gcr.study.hypotheses import Judged
from sb3_gcr.study.words import called, change, ends, number, p_value

#: Holm-corrected p below which a secondary comparison is said to be shown.
ALPHA = 0.05
#: More seeds than this are not counted.
MANY_SEEDS = 1_000
METRICS = {"return_training": "return over training", "return_final": "final return"}


class Verdict(Enum):
    """What an interval says."""

    HIGHER = "higher"
    LOWER = "lower"
    SAME = "no difference that matters"
    UNDECIDED = "undecided"


class Paid(NamedTuple):
    """What a regulariser returned before and after, and the contrast's numbers."""

    term: str
    before: float
    after: float
    low: float
    high: float
    holm: float
    relative: bool


def verdict(low: float, high: float, margin: float = MARGIN) -> Verdict:
    """Above 0, below 0, inside ±margin, or else undecided; NaN, no interval, is undecided.

    :param low: lower end of the interval
    :param high: upper end
    :param margin: the largest difference that does not matter
    """
    if low > 0.0:
        return Verdict.HIGHER
    if high < 0.0:
        return Verdict.LOWER
    if -margin < low and high < margin:
        return Verdict.SAME
    return Verdict.UNDECIDED


def secondary(contrast: Contrast) -> Verdict:
    """The verdict of a comparison that is one of several: a difference needs Holm's p as well."""
    found = verdict(contrast.low, contrast.high, contrast.margin)
    if found in (Verdict.HIGHER, Verdict.LOWER) and not contrast.holm < ALPHA:
        return Verdict.UNDECIDED
    return found


def opening(
    env: str,
    timesteps: Sequence[int],
    seeds: Sequence[int],
    failures: Sequence[tuple[str, int]],
    ended: int,
    n_cells: int | None,
) -> str:
    """The first sentence: what ran, what did not, and whether the study is at its end.

    :param env: or the configurations, in words
    :param timesteps: of the runs
    :param seeds: number of finished runs of each method
    :param failures: method and seed of each failed run
    :param ended: runs that are done or failed
    :param n_cells: all runs of the study, or None
    """
    interim = n_cells is not None and ended < n_cells
    head = f"Interim, {ended} of {n_cells} runs: " if interim else ""
    return (
        f"{head}{env}{_steps(timesteps)}, {_seeds(seeds)}, "
        f"equal settings{_failed(failures, ended)}."
    )


def _steps(timesteps: Sequence[int]) -> str:
    if not timesteps:
        return ""
    fewest, most = min(timesteps), max(timesteps)
    return f", {most:,} steps" if fewest == most else f", {fewest:,} to {most:,} steps"


def _seeds(counts: Sequence[int]) -> str:
    fewest, most = (min(counts), max(counts)) if counts else (0, 0)
    if fewest == most:
        return f"{most} seed" if most == 1 else f"{most} seeds"
    return f"{fewest} to {most} seeds"


def _failed(failures: Sequence[tuple[str, int]], ended: int) -> str:
    if not failures:
        return ""
    names = ", ".join(f"{called(method)} with seed {seed}" for method, seed in failures)
    return f"; {len(failures)} of {ended} runs failed ({names})"


def headline(contrast: Contrast, where: str = "here", pairs: str = "pairs of runs") -> str:
    """The answer to the question of the study.

    :param contrast: the main method against the baseline, return over training
    :param where: it holds
    :param pairs: what the pairs are
    """
    method, baseline = called(contrast.method), called(contrast.baseline)
    found = verdict(contrast.low, contrast.high, contrast.margin)
    numbers = _headline_numbers(contrast, pairs)
    if found is Verdict.HIGHER:
        return f"{method} learns faster than {baseline} {where}: {numbers}."
    if found is Verdict.LOWER:
        return f"Use {baseline}, {method} learns more slowly {where}: {numbers}."
    if found is Verdict.SAME:
        return f"No difference that matters between {method} and {baseline} {where}: {numbers}."
    return f"{_undecided(contrast)}. {method} against {baseline}: {numbers}."


def _headline_numbers(contrast: Contrast, pairs: str) -> str:
    estimate = change(contrast.estimate, contrast.relative)
    interval = ""
    if contrast.has_interval:
        interval = f" (95 % interval {ends(contrast)}, {contrast.kind})"
    return (
        f"{METRICS.get(contrast.metric, contrast.metric)} {estimate}{interval}, "
        f"better in {contrast.better} of {contrast.pairs} {pairs}"
    )


def _undecided(contrast: Contrast) -> str:
    if not contrast.has_interval:
        unit = "configuration" if contrast.kind == "Student" else "seed"
        return f"Undecided: one {unit} has no interval, run at least 2"
    more = contrast.more_seeds
    if more is None:
        return "Undecided"
    if more > MANY_SEEDS:
        return f"Undecided: more than {MANY_SEEDS:,} more seeds"
    return f"Undecided: about {more} more {'seed' if more == 1 else 'seeds'}"


def no_headline(method: str, baseline: str, n_method: int, n_baseline: int) -> str:
    """What is said where a method has no finished run."""
    missing = [called(name) for name, n in ((method, n_method), (baseline, n_baseline)) if n == 0]
    return f"No answer yet: no finished run of {' and none of '.join(missing)}."


def cause(main: Verdict, surgery: Contrast, heads: Contrast) -> str:
    """Whether the surgery or the heads did it.

    :param main: of the headline
    :param surgery: the main method against the heads alone
    :param heads: the heads alone against the baseline
    """
    verdicts = (secondary(surgery), secondary(heads))
    over_heads = f"{_brief(surgery)} over {called(surgery.baseline)}"
    over_baseline = f"{_brief(heads)} over {called(heads.baseline)}"
    if main not in (Verdict.HIGHER, Verdict.LOWER):
        return (
            f"Surgery: {_word(surgery)}, {over_heads}; heads alone: {_word(heads)}, "
            f"{over_baseline}."
        )
    does = "does it" if main is Verdict.HIGHER else "costs it"
    do = "do it" if main is Verdict.HIGHER else "cost it"
    if verdicts == (main, main):
        return f"The surgery and the heads both {do}: {over_heads}, which is {over_baseline}."
    if verdicts[0] is main and verdicts[1] is Verdict.UNDECIDED:
        return f"The surgery {does}: {over_heads}; of the heads nothing is shown, {over_baseline}."
    if verdicts[0] is main:
        return f"The surgery {does}, not the heads: {over_heads}."
    if verdicts[1] is main and verdicts[0] is Verdict.UNDECIDED:
        return f"The heads {do}: {over_baseline}; of the surgery nothing is shown, {over_heads}."
    if verdicts[1] is main:
        return f"The heads {do}, not the surgery: {over_baseline}."
    return (
        f"Whether the surgery or the heads {do} is not shown: {over_heads}, which is "
        f"{over_baseline}."
    )


def _word(contrast: Contrast) -> str:
    found = secondary(contrast)
    return "no difference shown" if found is Verdict.UNDECIDED else found.value


def _brief(contrast: Contrast) -> str:
    """An estimate with its interval, as in "+11 % (2 to 20)"."""
    estimate = change(contrast.estimate, contrast.relative)
    return f"{estimate} ({ends(contrast)})" if contrast.has_interval else estimate


def final(contrast: Contrast) -> str:
    """The sentence on the deterministic policy at the end of training."""
    estimate = change(contrast.estimate, contrast.relative)
    interval = f", {ends(contrast)}" if contrast.has_interval else ""
    return f"Final return: {_word(contrast)} ({estimate}{interval})."


def against(contrast: Contrast) -> str:
    """One more method against the baseline."""
    return (
        f"{called(contrast.method)} against {called(contrast.baseline)}: {_word(contrast)}, "
        f"{_brief(contrast)}."
    )


def regularisers(terms: Sequence[Paid], margin: float = MARGIN) -> str:
    """What the regularisers paid: those whose return fell, Holm-corrected.

    :param terms: the regularisers, before under the baseline and after under the main method
    :param margin: the largest fall that does not matter, as a share
    """
    if not terms:
        return "There are no regularisers."
    paid = [term for term in terms if _has_paid(term)]
    if paid:
        n = len(terms) - len(paid)
        others = "" if n == 0 else f" {n} {'other' if n == 1 else 'others'} did not."
        return f"Regularisers paid: {_arrows(paid)}.{others}"
    if all(_is_spared(term, margin) for term in terms):
        return f"Regularisers paid for nothing: {_arrows(terms)}."
    return f"No regulariser is shown to have paid: {_arrows(terms)}."


def _has_paid(term: Paid) -> bool:
    return term.high < 0.0 and term.holm < ALPHA


def _is_spared(term: Paid, margin: float) -> bool:
    """Whether the interval leaves out a fall that matters; without a share, any fall."""
    return term.low > -margin if term.relative else term.low >= 0.0


def _arrows(terms: Sequence[Paid]) -> str:
    return ", ".join(f"{one.term} {number(one.before)} -> {number(one.after)}" for one in terms)


def conflicts(count: float, pairs: int, worst: str, cosine: float) -> str:
    """How many pairs conflict, and which most.

    :param count: mean number of conflicting pairs
    :param pairs: K (K - 1) / 2
    :param worst: the pair with the lowest cosine at the end of training
    :param cosine: of that pair
    """
    if math.isnan(count):
        return "No conflicts were measured."
    lead = f"{number(count, 2)} of {pairs} {'pair' if pairs == 1 else 'pairs'} conflict"
    if not worst or not cosine < 0.0:
        return f"{lead}."
    return f"{lead}; most of all {worst} (cosine {cosine:.2f} at the end)."


def hypothesis(one: Judged) -> str:
    """What the cells say to a registered hypothesis.

    :param one: with its status
    """
    words = {
        "supported": "supported",
        "refuted": "refuted",
        "opposite": "not supported, the opposite is shown",
        "open": "open",
        "no look yet": "no look yet",
    }[one.status]
    lead = f"{one.name}, {words}: {one.claim.rstrip('.')}."
    if one.contrast is None:
        return f"{lead} No unit has both methods yet."
    if one.detail:
        return f"{lead} {one.detail}"
    c = one.contrast
    unit = "seeds" if c.kind == "Welch" else "configurations"
    interval = f" ({ends(c)}, {c.kind})" if c.has_interval else ""
    numbers = (
        f"{called(c.method)} over {called(c.baseline)} {change(c.estimate, c.relative)}{interval} "
        f"in {one.n} {unit}"
    )
    look = f", Holm p {p_value(one.holm)} at the look of {one.look}" if one.look else ""
    wins = f", better in {c.better} of {c.pairs}"
    evidence = f" (E = {number(one.evidence.e)})" if one.evidence is not None else ""
    return f"{lead} {numbers}{look}{wins}{evidence}."


def no_share(baseline: str, configuration: str) -> str:
    """The warning that differences are not in per cent.

    :param baseline: of the headline
    :param configuration: where it is so
    """
    return (
        f"On {configuration} the return of {called(baseline)} over training is not shown to be "
        "above that of random actions: differences are in the return's own unit, without a margin. "
        "Give it more steps."
    )


def mixed_digests(method: str, baseline: str, configuration: str, counts: dict[str, int]) -> str:
    """The warning that a contrast has cells of several versions of the code."""
    versions = ", ".join(f"{str(digest)[:12]}: {n}" for digest, n in counts.items())
    return (
        f"{called(method)} against {called(baseline)} on {configuration} mixes cells of "
        f"{len(counts)} versions of the code ({versions}): run them again with one version before "
        "you trust the difference."
    )
