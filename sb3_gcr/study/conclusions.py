"""What a study says: its contrasts, the sentences made of them, and what to be careful about."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from sb3_gcr.study import answers
from sb3_gcr.study.collected import Collected
from sb3_gcr.study.contrasts import Contrast, corrected, over_configurations
from sb3_gcr.study.frames import Frames
from sb3_gcr.study.hypotheses import Judged, judged
from sb3_gcr.study.registration import registration
from sb3_gcr.study.scores import Scores, scaled
from sb3_gcr.study.tables import (
    FINAL,
    TRAINING,
    Answer,
    Roles,
    compared,
    mean_cosines,
    pair_table,
    roles,
    sample,
    term_table,
)
from sb3_gcr.study.words import called

if TYPE_CHECKING:
    import pandas as pd


class Conclusions(NamedTuple):
    """What a report says before it shows anything.

    :param methods: in the order of the manifest
    :param who: the methods' parts; None with fewer than two methods
    :param by_configuration: the contrasts of each configuration
    :param overall: the contrasts over configurations; None where there is one configuration
    :param sentences: the answer
    :param warnings: what to be careful about
    :param hypotheses: of the manifest
    :param registration: when they were committed, in a sentence
    """

    methods: tuple[str, ...]
    who: Roles | None
    by_configuration: dict[str, Answer]
    overall: Answer | None
    sentences: tuple[str, ...]
    warnings: tuple[str, ...]
    hypotheses: tuple[Judged, ...]
    registration: str


def conclude(study: Collected, data: Frames) -> Conclusions:
    """Everything that the finished cells allow to say.

    :param study: the folder
    :param data: its frames
    """
    methods = methods_of(study, data.cells)
    who = roles(methods)
    configurations = list(dict.fromkeys(data.cells["configuration"]))
    by_configuration = {}
    overall = None
    hypotheses: list[Judged] = []
    warnings = general_warnings(study, data.cells)
    if who is not None:
        for name in configurations:
            cells = data.cells[data.cells["configuration"] == name]
            by_configuration[name] = compared(cells, who)
            warnings += contrast_warnings(name, cells, by_configuration[name])
        scores = scaled(data.cells, who)
        hypotheses = judged(study.manifest, data.cells, data.factors, scores)
        if len(configurations) > 1:
            overall = compared_over(scores, who)
            warnings += _left_out(scores.left_out, who)
    sentences = [_opening(study, data, methods)]
    sentences += [answers.hypothesis(one) for one in hypotheses]
    if who is None:
        sentences.append("No comparison: the study has one method.")
    elif len(configurations) == 1:
        sentences += _one(study, data, who, by_configuration[configurations[0]])
    elif overall is not None:
        sentences += _several(data, who, overall)
    return Conclusions(
        methods,
        who,
        by_configuration,
        overall,
        tuple(sentences),
        tuple(dict.fromkeys(warnings)),
        tuple(hypotheses),
        registration(study),
    )


def methods_of(study: Collected, cells: pd.DataFrame) -> tuple[str, ...]:
    """The methods in the order of the manifest, then any others."""
    names = [str(name) for name in study.manifest.get("methods") or []]
    failed = [failure.method for failure in study.failures]
    return tuple(dict.fromkeys([*names, *cells["method"], *failed]))


def compared_over(scores: Scores, who: Roles) -> Answer:
    """The contrasts over configurations; all but the headline are Holm-corrected together."""

    def against(baseline: str | None, method: str, metric: str = TRAINING) -> Contrast | None:
        a = scores.samples.get((str(baseline), metric), {})
        b = scores.samples.get((method, metric), {})
        both = [name for name in a if name in b]
        if not both:
            return None
        return over_configurations(
            str(baseline), method, metric, [a[name] for name in both], [b[name] for name in both]
        )

    rest = {
        "surgery": against(who.heads, who.main),
        "heads": against(who.baseline, who.heads) if who.heads else None,
        "final": against(who.baseline, who.main, FINAL),
    } | {name: against(who.baseline, name) for name in who.others}
    known = {key: one for key, one in rest.items() if one is not None}
    known = dict(zip(known, corrected(list(known.values())), strict=True))
    others = tuple(known[name] for name in who.others if name in known)
    return Answer(
        against(who.baseline, who.main),
        known.get("surgery"),
        known.get("heads"),
        known.get("final"),
        others,
    )


def _opening(study: Collected, data: Frames, methods: Sequence[str]) -> str:
    cells = data.cells
    configurations = list(dict.fromkeys(cells["configuration"]))
    envs = list(dict.fromkeys([*cells["env"], *(failure.env for failure in study.failures)]))
    what = " and ".join(envs) if len(envs) <= 3 else f"{len(envs)} envs"
    if len(configurations) > len(envs):
        what = f"{len(configurations)} configurations of {what}"
    per = cells.groupby(["configuration", "method"]).size() if len(cells) else []
    counts = [int(n) for n in per] or [0]
    if any(method not in set(cells["method"]) for method in methods):
        counts.append(0)
    return answers.opening(
        what or study.name,
        [int(n) for n in cells["timesteps"]],
        counts,
        [(failure.method, failure.seed) for failure in study.failures],
        study.n_ended,
        study.n_cells,
    )


def _one(study: Collected, data: Frames, who: Roles, found: Answer) -> list[str]:
    """The sentences of a comparison on one configuration."""
    if found.headline is None:
        n = [len(sample(data.cells, name, TRAINING)) for name in (who.main, who.baseline)]
        return [answers.no_headline(who.main, who.baseline, *n)]
    sentences = [answers.headline(found.headline), *_rest(found)]
    terms = paid(term_table(data.terms, who.baseline, who.main))
    sentences.append(answers.regularisers(terms))
    sentences.append(_conflicts(study, data, who))
    return sentences


def _rest(found: Answer) -> list[str]:
    sentences = []
    if found.headline is not None and found.surgery is not None and found.heads is not None:
        main = answers.verdict(found.headline.low, found.headline.high, found.headline.margin)
        sentences.append(answers.cause(main, found.surgery, found.heads))
    if found.final is not None:
        sentences.append(answers.final(found.final))
    return sentences + [answers.against(one) for one in found.others]


def _several(data: Frames, who: Roles, found: Answer) -> list[str]:
    """The sentences over configurations."""
    if found.headline is None:
        n = [len(sample(data.cells, name, TRAINING)) for name in (who.main, who.baseline)]
        return [answers.no_headline(who.main, who.baseline, *n)]
    where = f"over {found.headline.pairs} configurations"
    return [answers.headline(found.headline, where, "configurations"), *_rest(found)]


def _conflicts(study: Collected, data: Frames, who: Roles) -> str:
    results = [one for one in study.results if one["cell"]["method"] == who.main]
    cosines = mean_cosines(results)
    cells = data.cells[data.cells["method"] == who.main]
    if cosines is None:
        return answers.conflicts(float("nan"), 0, "", 0.0)
    n = len(cosines.names)
    worst = pair_table(cosines, {}).iloc[0]
    count = float(cells["conflict_count"].mean())
    return answers.conflicts(count, n * (n - 1) // 2, worst["pair"], worst["last"])


def paid(table: pd.DataFrame) -> list[answers.Paid]:
    """The regularisers of a table of terms."""
    rows = table[table["level"] >= 1]
    return [
        answers.Paid(
            row.term, row.before, row.after, row.low, row.high, row.holm, bool(row.relative)
        )
        for row in rows.itertuples()
    ]


def general_warnings(study: Collected, cells: pd.DataFrame) -> list[str]:
    """What does not belong to a single contrast."""
    warnings = []
    for metric in (TRAINING, FINAL):
        n = int(cells[metric].isna().sum())
        if n:
            runs = "run has" if n == 1 else "runs have"
            warnings.append(
                f"{n} {runs} no {answers.METRICS[metric]} and cannot be counted: did no episode "
                "end?"
            )
    n = int(cells["dirty"].sum()) if len(cells) else 0
    if n:
        warnings.append(
            f"{n} of {len(cells)} runs were made with changes that are in no commit: nobody else "
            "can repeat them."
        )
    return warnings


def contrast_warnings(configuration: str, cells: pd.DataFrame, found: Answer) -> list[str]:
    """Contrasts without a share or of mixed versions, and seeds that change nothing."""
    warnings = []
    if found.headline is not None and not found.headline.relative:
        warnings.append(answers.no_share(found.headline.baseline, configuration))
    for one in found.contrasts[:1] + [c for c in (found.surgery, found.heads) if c is not None]:
        own = cells[cells["method"].isin([one.baseline, one.method])]
        counts = own["digest"].fillna("unknown").value_counts().to_dict()
        if len(counts) > 1:
            versions = {str(key): int(n) for key, n in sorted(counts.items())}
            warnings.append(
                answers.mixed_digests(one.method, one.baseline, configuration, versions)
            )
    for method, group in cells.groupby("method", sort=False):
        values = sample(group, str(method), TRAINING)
        if len(values) > 1 and values.min() == values.max():
            warnings.append(
                f"All {len(values)} runs of {called(str(method))} on {configuration} have "
                "the same return: does the seed reach the env and the policy?"
            )
    return warnings


def _left_out(names: Sequence[str], who: Roles) -> list[str]:
    if not names:
        return []
    return [
        f"Left out of the overall numbers, because {called(who.baseline)} does not beat "
        f"random actions there, or one of the two is not known: {', '.join(names)}."
    ]
