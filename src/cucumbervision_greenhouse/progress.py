"""The progress of a round: captures that wait and are measured, the same on every page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cucumbervision_greenhouse.language import counted
from cucumbervision_greenhouse.language import gettext as _

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from cucumbervision_greenhouse.jobs import Job
    from cucumbervision_greenhouse.store.waiting import Waiting


@dataclass(frozen=True)
class Progress:
    """The progress of a round.

    Parameters
    ----------
    waiting : int
        Captures of the round that are saved and not yet measured.
    measured : int
        Captures that were measured since the queue was last empty.
    aside : int
        Captures that failed three times; they are kept and not tried again.
    elsewhere : int
        Captures of other rounds that wait.
    fault : str
        Why no capture can be measured; empty if they can.
    title, done, total : str, int
        Other work on the round or on none, and its steps; a total of 0 is unknown.
    """

    waiting: int = 0
    measured: int = 0
    aside: int = 0
    elsewhere: int = 0
    fault: str = ""
    title: str = ""
    done: int = 0
    total: int = 0

    @property
    def words(self) -> str:
        """The current work, for people; empty if there is none.

        Examples
        --------
        >>> Progress(waiting=31, measured=12).words
        'Measuring: 12 of 43 captures'
        >>> Progress(waiting=1, elsewhere=3).words
        'Measuring: 0 of 1 capture; 3 of other rounds wait too'
        >>> Progress(title="Loading the networks").words, Progress(elsewhere=2).words
        ('Loading the networks …', 'Measuring 2 captures of other rounds')
        >>> Progress(waiting=2, fault="lost.json: is not there").words
        '2 captures wait to be measured: lost.json: is not there'
        """
        captures, total = "", self.waiting + self.measured
        if self.waiting and self.fault:
            return counted(
                self.waiting,
                "{n} capture waits to be measured: {fault}",
                "{n} captures wait to be measured: {fault}",
                fault=self.fault,
            )
        if self.waiting:
            captures = counted(
                total,
                "Measuring: {done} of {n} capture",
                "Measuring: {done} of {n} captures",
                done=self.measured,
            )
        if captures:
            elsewhere = ""
            if self.elsewhere:
                elsewhere = counted(
                    self.elsewhere, "{n} of other rounds waits too", "{n} of other rounds wait too"
                )
            return "; ".join(filter(None, (captures, elsewhere)))
        if self.title:
            words = _("{title}: {done} of {all}") if self.total else "{title} …"
            return words.format(title=_(self.title), done=self.done, all=self.total)
        if self.elsewhere:
            return counted(
                self.elsewhere,
                "Measuring {n} capture of other rounds",
                "Measuring {n} captures of other rounds",
            )
        return ""

    @property
    def first_words(self) -> str:
        """The text in place of the stops of an empty round; empty if no stop is to come.

        Examples
        --------
        >>> Progress(waiting=30).first_words
        '30 captures are saved, and none is measured yet. Their results appear here.'
        >>> Progress(aside=1).first_words
        '1 capture could not be measured; it is kept beside the store.'
        """
        if self.waiting:
            return counted(
                self.waiting,
                "{n} capture is saved, and not measured yet. Its results appear here.",
                "{n} captures are saved, and none is measured yet. Their results appear here.",
            )
        if self.aside:
            return counted(
                self.aside,
                "{n} capture could not be measured; it is kept beside the store.",
                "{n} captures could not be measured; they are kept beside the store.",
            )
        return ""

    @property
    def told(self) -> dict[str, Any]:
        """The progress for a browser: words, and the steps of the bar; a total of 0 is unknown."""
        steps = self.measured, self.waiting + self.measured
        if not self.waiting:
            steps = self.done, self.total
        return {"words": self.words, "done": steps[0], "total": steps[1], "waiting": self.waiting}


def progress_of(
    round_key: str,
    captures: Iterable[Waiting],
    aside: Iterable[Waiting] = (),
    measured: Mapping[str, str] | None = None,
    jobs: Iterable[Job] = (),
    fault: str = "",
) -> Progress:
    """Return the work on a round.

    Parameters
    ----------
    round_key : str
        The round.
    captures : iterable of Waiting
        The queue, of all rounds.
    aside : iterable of Waiting
        Those that are not tried again, of all rounds.
    measured : mapping of str to str
        Captures of the queue that were measured since it was empty, by key, each with its round.
    jobs : iterable of Job
        Those that wait or run, in their order.
    fault : str
        Why the queue cannot be measured; empty where it can.
    """
    stops = measured or {}
    queued = [capture.round_key == round_key for capture in captures if capture.key not in stops]
    job = next((candidate for candidate in jobs if candidate.round_key in ("", round_key)), None)
    return Progress(
        waiting=sum(queued),
        measured=list(stops.values()).count(round_key),
        aside=sum(capture.round_key == round_key for capture in aside),
        elsewhere=len(queued) - sum(queued),
        fault=fault,
        title=job.title if job else "",
        done=job.done if job else 0,
        total=job.total if job else 0,
    )
