"""Whether the hypotheses of a study were committed before its first cell."""

from __future__ import annotations

from datetime import datetime, timezone

from sb3_gcr.study.collected import Collected

FORMAT = "%Y-%m-%d %H:%M UTC"


def registration(study: Collected) -> str:
    """The commit of the manifest and whether it came before the first cell, in a sentence.

    :param study: with ``registered`` in its manifest: commit, date, changed
    :return: nothing for a study without hypotheses
    """
    if not study.manifest.get("hypotheses"):
        return ""
    registered = study.manifest.get("registered")
    if not registered:
        return "The hypotheses are in no commit: nothing shows that they came before the cells."
    committed = moment(str(registered["date"]))
    lead = f"The hypotheses were committed in {str(registered['commit'])[:10]} on "
    lead += f"{committed.strftime(FORMAT)}"
    if registered.get("changed"):
        return f"{lead}, but the study was started with a file that DIFFERS from that commit."
    started = first_start(study)
    if started is None:
        return f"{lead}; no cell says when it began."
    began = started.strftime(FORMAT)
    if committed <= started:
        return f"{lead}, before the first cell ({began})."
    return f"{lead}, which is LATER than the first cell ({began})."


def first_start(study: Collected) -> datetime | None:
    """When the first cell began; None where no cell says."""
    times = [(one.get("provenance") or {}).get("started") for one in study.results]
    return min((moment(str(time)) for time in times if time), default=None)


def moment(text: str) -> datetime:
    """A time as git and the cells write it, in UTC.

    :param text: ISO 8601 with a time zone; Python 3.10 does not know its letter Z
    """
    return datetime.fromisoformat(text.replace("Z", "+00:00")).astimezone(timezone.utc)
